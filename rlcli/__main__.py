"""`python -m rlcli`: the same as the `rlcli` command, which does not import from the current folder either."""

import os
import sys

if not sys.flags.safe_path and sys.path and sys.path[0] in ("", os.getcwd()):
    del sys.path[0]

from rlcli.cli.app import main

sys.exit(main())
