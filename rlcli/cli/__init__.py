"""The command line of rlcli: main function (`app`), one module for each command (`commands`), output (`ui`)."""

import signal


def main() -> int:
    """Run the command `rlcli` of this process and return its exit code.

    While the modules of the command line are imported, Ctrl-C ends the process without a traceback.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from rlcli.cli.app import main as run_command

    return run_command()
