"""Entry point of `python -m rlcli`, which is the same as the command `rlcli`.

Python puts the current folder first on `sys.path`. This module removes the folder again, because the command `rlcli`
does not import from the current folder either.
"""

import os
import sys

try:
    current = os.getcwd()
except OSError:  # the current folder was deleted; `main` reports this
    current = ""
if not sys.flags.safe_path and sys.path and sys.path[0] in ("", current):
    del sys.path[0]

from rlcli.cli import main

sys.exit(main())
