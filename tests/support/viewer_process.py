"""`rlcli play` as a separate process, with its output.

`Playing` waits until the viewer prints an address, so it fits viewers that are servers. For a viewer that draws in the
terminal see `support.pseudo_terminal`.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PATIENCE = 120.0


class Playing:
    """A running `rlcli play ... --viewer web`, stopped at the end of the block."""

    def __init__(self, *arguments, **variables):
        self._folder = tempfile.TemporaryDirectory()
        self._files = [Path(self._folder.name) / name for name in ("out", "err")]
        kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION")}
        calm = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        with self._files[0].open("w") as out, self._files[1].open("w") as err:
            command = [sys.executable, "-m", "rlcli", "play", *map(str, arguments)]
            self.process = subprocess.Popen(command, stdout=out, stderr=err, env={**kept, **calm, **variables})

    def __enter__(self):
        end = time.monotonic() + PATIENCE
        while not (found := re.search(r"http://([^/\s]+:(\d+))/", self.err)):
            assert self.process.poll() is None, self.err
            assert time.monotonic() < end, self.err
            time.sleep(0.1)
        self.url, self.host, self.port = found[0], found[1], int(found[2])
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.out, self.err_at_end = self._files[0].read_text(), self.err
        self._folder.cleanup()

    @property
    def err(self):
        """Return the output on stderr so far."""
        return self._files[1].read_text() if self._files[1].exists() else self.err_at_end

    def interrupt(self):
        """Send Ctrl-C; return the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(timeout=PATIENCE)

    def answers(self):
        """Return whether its port accepts connections."""
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0
