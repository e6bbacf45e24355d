"""`rlcli` as a separate process on a pseudo-terminal, for output that depends on a terminal. It needs Unix."""

import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios


def run_on_terminal(arguments, folder, *, columns=120, interrupt_after=b"", **variables):
    """Run a command on a terminal and return (exit code, output of stdout and stderr as bytes).

    `interrupt_after`: Ctrl-C is sent when this text has been printed, for commands that do not end on their own.
    """
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    kept = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    process = subprocess.Popen(
        [sys.executable, "-m", "rlcli", *arguments],
        stdin=follower,
        stdout=follower,
        stderr=follower,
        cwd=folder,
        env={**kept, "TERM": "xterm-256color", **variables},
    )
    os.close(follower)
    output = b""
    try:
        while chunk := os.read(leader, 65536):
            output += chunk
            if interrupt_after and interrupt_after in output:
                process.send_signal(signal.SIGINT)
                interrupt_after = b""
    except OSError:  # Linux raises this when the other end is closed
        pass
    os.close(leader)
    return process.wait(), output
