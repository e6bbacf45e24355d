"""`python -m rlcli`: the same as the `rlcli` command."""

import sys

from rlcli.cli.app import main

sys.exit(main())
