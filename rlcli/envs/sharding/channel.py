"""Connection between the main process and a worker process, which sends and receives messages over a socket.

Large tensors do not go through the socket, but through shared memory (`arrays`).
"""

from __future__ import annotations

import pickle
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

_HEADER = struct.Struct("=2sq")
"""Kind of the message, and size of its pickled content [bytes]."""
SPIN_S = 1e-3
"""Time for which a receiver polls before it sleeps [s]. A process that slept starts up to 0.2 ms late, and its core's
caches are cold."""


class ChannelClosedError(Exception):
    """Error that the process at the other end of a connection has ended."""


class Channel:
    """One end of a connection. A message has a kind (one or two bytes) and a content, pickled unless it is None.

    Both ends belong to the same user and the same command: nothing else can connect.

    Args:
        connection: a stream socket.
        spin_s: time to poll for a message before sleeping [s].
    """

    def __init__(self, connection: socket.socket, spin_s: float) -> None:
        self._socket, self._spin_s = connection, spin_s
        self._sending = threading.Lock()
        self._socket.setblocking(True)

    def send(self, kind: bytes, content: Any = None) -> None:
        """Send a message; any thread may do this.

        Raises:
            ChannelClosedError: if the other process has ended.
        """
        body = b"" if content is None else pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL)
        try:
            with self._sending:
                self._socket.sendall(_HEADER.pack(kind, len(body)) + body)
        except OSError as error:
            raise ChannelClosedError from error

    def receive(self, wait: Callable[[], None] = lambda: None) -> tuple[bytes, Any]:
        """Wait for a message; return its kind and content.

        If no message comes while this process polls, it calls `wait` and then sleeps until a message comes.

        Raises:
            ChannelClosedError: if the other process has ended.
        """
        kind, size = _HEADER.unpack(self._first_bytes(_HEADER.size, wait))
        return kind.rstrip(b"\0"), pickle.loads(self._read(size)) if size else None

    def is_silent(self, seconds: float) -> bool:
        """Return True if within `seconds` no message comes and the other process does not end."""
        return not select.select([self._socket], [], [], seconds)[0]

    def wait_until_closed(self) -> None:
        """Discard messages until the other process closes its end."""
        while self._socket.recv(1 << 16):
            pass

    def close(self) -> None:
        """Close this end of the connection."""
        self._socket.close()

    def _first_bytes(self, size: int, wait: Callable[[], None]) -> bytes:
        """Return the first bytes of a message; poll for a short time, then sleep."""
        end = time.perf_counter() + self._spin_s
        while time.perf_counter() < end:
            try:
                data = self._socket.recv(size, socket.MSG_DONTWAIT)
            except BlockingIOError:
                continue
            except OSError as error:
                raise ChannelClosedError from error
            return data if len(data) == size else data + self._read(size - len(data), ended=not data)
        wait()
        return self._read(size)

    def _read(self, size: int, ended: bool = False) -> bytes:
        buffer, done = bytearray(size), 0
        while done < size:
            try:
                count = 0 if ended else self._socket.recv_into(memoryview(buffer)[done:])
            except OSError as error:
                raise ChannelClosedError from error
            if count == 0:
                raise ChannelClosedError
            done += count
        return bytes(buffer)
