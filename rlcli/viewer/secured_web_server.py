"""MuJoCo's web viewer behind a fence: on the loopback interface alone, for its own page alone, silent.

What MuJoCo ships (`mujoco.studio`, private and new in 4.0) listens on every interface, answers any page and takes its
models. The module is left as it is on disk; while a viewer runs, the few functions that open sockets and answer
requests are replaced here. `verify_refusals` then sends requests that the server must refuse.
"""

from __future__ import annotations

import contextlib
import errno
import http.client
import importlib
import inspect
import logging
import os
import socket
import stat
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import mujoco

from rlcli.errors import DependencyError, MachineError
from rlcli.viewer.access import refusal_reason, response_headers

_REQUIRED_NAMES = {
    "web_viewer": ("WebViewer", "web_server", "_print_url_banner"),
    "web.web_server": ("serve", "bind_public_socket", "bind_loopback_socket", "WebServer", "Response", "Headers"),
    "web.headless_ui": ("HeadlessUi",),
    "web.state_payload": ("MAX_EXTRA_GEOMS",),
    "launch_thread": ("make_thread_endpoints",),
    "viewer_protocol": ("ViewerConfig", "run_viewer_loop"),
    "messages": (
        "StateSnapshot",
        "ModelEvent",
        "PostModelEvent",
        "ExitEvent",
        "UpdateEvent",
        "BuildGuiEvent",
        "handler",
    ),
    "plugin": ("ViewerPlugin", "ViewerInitEvent", "ThemeEvent"),
    "ux": ("UxState", "setup_theme", "configure_docking_layout", "view_gizmo_gui", "rendering_gui", "groups_gui"),
    "app.inputs": ("handle_mouse_events", "handle_vis_options_keyboard_events", "handle_camera_select_keyboard_events"),
    "dear_imgui.dear_imgui": ("Begin", "Button", "Combo", "SliderFloat", "IsKeyChordPressed"),
}
"""Module of `mujoco.studio` -> what is used of it."""
_MOST_OF_A_MESSAGE = 2**20


def load() -> SimpleNamespace:
    """The modules of the viewer, by the last part of their names.

    Raises:
        DependencyError: if the installed MuJoCo has no such viewer.
    """
    found, lacks = {}, []
    for name, attributes in _REQUIRED_NAMES.items():
        try:
            module = importlib.import_module(f"mujoco.studio.{name}")
        except Exception as error:  # a wheel without it, or with another one; whatever an import may raise
            raise incompatible_viewer(f"{type(error).__name__}: {error}") from None
        lacks += [f"{name}.{attribute}" for attribute in attributes if not hasattr(module, attribute)]
        found[name.rpartition(".")[2]] = module
    if not lacks:
        expected = {"config", "endpoint", "model", "plugins", "camera"}
        missing = expected - set(inspect.signature(found["web_viewer"].WebViewer).parameters)
        lacks += [f"web_viewer.WebViewer({name})" for name in sorted(missing)]
    if lacks:
        raise incompatible_viewer(f"it lacks {', '.join(lacks[:5])}")
    return SimpleNamespace(**found)


def incompatible_viewer(why: str) -> DependencyError:
    """What to say where MuJoCo's viewer is not the one that this module knows."""
    return DependencyError(
        f"the browser's viewer does not work with the installed mujoco {mujoco.__version__}: {' '.join(why.split())}",
        hint='pip install "mujoco==4.0.*", or use --video FILE.mp4, or --viewer none',
    )


def listen(port: int) -> socket.socket:
    """A listening socket on the loopback interface; port 0: a free one.

    Raises:
        MachineError: if the port is taken, or not allowed.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if os.name == "posix":  # else a port stays taken for a minute after its server has gone
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
        listener.listen()
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise MachineError(
                f"port {port} is in use, perhaps by another viewer", hint="--port 0 takes a free one, --port N another"
            ) from None
        raise MachineError(
            f"port {port} cannot be opened: {error.strerror}", hint="--port 0 takes a free one"
        ) from None
    return listener


@contextlib.contextmanager
def secured_server(studio: SimpleNamespace, listener: socket.socket) -> Iterator[None]:
    """While it lasts, a viewer that is made uses this socket, asks the gate and prints nothing."""
    server, viewer = studio.web_server, studio.web_viewer
    port = listener.getsockname()[1]
    ours: list[tuple[Any, str, Any]] = [
        (server, "serve", _serve_with_checks(server, port)),
        (server, "bind_public_socket", lambda *_: listener),
        (server, "bind_loopback_socket", lambda *_: _inner_listener()),
        (viewer, "_print_url_banner", lambda *_: None),
        (viewer, "print", lambda *_, **__: None),
    ]
    before = [(module, name, getattr(module, name, None)) for module, name, _ in ours]
    for module, name, value in ours:
        setattr(module, name, value)
    with _quiet():
        try:
            yield
        finally:
            for module, name, value in before:
                delattr(module, name) if value is None else setattr(module, name, value)


def verify_refusals(port: int) -> None:
    """Ask the running server for its page, and for what it must refuse.

    Raises:
        DependencyError: if it does not refuse.
    """
    own = f"127.0.0.1:{port}"
    asked = {
        "its page": ({"Host": own}, 200),
        "a foreign Host": ({"Host": f"rlcli.invalid:{port}"}, 403),
        "a foreign Origin": ({"Host": own, "Origin": "http://rlcli.invalid"}, 403),
    }
    for what, (given, expected) in asked.items():
        status = _status(port, given)
        if status != expected:
            raise incompatible_viewer(f"asked with {what}, it answers {status}")


def _status(port: int, given: dict[str, str]) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.putrequest("GET", "/", skip_host=True)
        for name, value in given.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse().status
    except (OSError, http.client.HTTPException) as error:
        raise incompatible_viewer(f"its server does not answer: {error}") from None
    finally:
        connection.close()


def _serve_with_checks(server: Any, port: int) -> Any:
    """`websockets`' serve, with the gate before what the viewer does with a request."""
    serve, own = server.serve, response_headers(port)

    def serve_checked(*places: Any, process_request: Any, process_response: Any, **settings: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            given: dict[str, list[str]] = {}
            for name, value in request.headers.raw_items():
                given.setdefault(name.lower(), []).append(value)
            why = refusal_reason(port, request.path, given)
            if why is not None:
                body = f"refused: {why}\n".encode()
                said = server.Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
                return server.Response(403, "Forbidden", said, body)
            return process_request(connection, request)

        def answer(connection: Any, request: Any, response: Any) -> Any:
            """Any answer, a refusal too: without what lets other pages read it."""
            response = process_response(connection, request, response) or response
            for name in ("Access-Control-Allow-Origin", *own):
                if name in response.headers:
                    del response.headers[name]
            response.headers.update(own)
            return response

        return serve(
            *places, **{**settings, "max_size": _MOST_OF_A_MESSAGE}, process_request=check, process_response=answer
        )

    return serve_checked


class _InnerListener(socket.socket):
    """Takes connections of this process alone: the drawing of the panel comes over the loopback interface too."""

    def accept(self) -> tuple[socket.socket, Any]:
        """As every socket's."""
        connection, peer = super().accept()
        if _is_ours(peer):
            return connection, peer
        connection.close()
        raise ConnectionAbortedError


def _inner_listener() -> socket.socket:
    listener = _InnerListener(socket.AF_INET, socket.SOCK_STREAM)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    return listener


def _is_ours(peer: object) -> bool:
    """Whether the socket at an address is one of this process, as far as the system tells."""
    try:
        numbers = [int(name) for name in os.listdir("/dev/fd")]
    except OSError:
        return True
    for number in numbers:
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                with socket.socket(fileno=os.dup(number)) as copy:
                    if copy.family == socket.AF_INET and copy.getsockname() == peer:
                        return True
    return False


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """What the viewer logs goes to stderr, and only what is wrong; that a browser has gone is not wrong."""
    log, loop = logging.getLogger("WebServer"), logging.getLogger("asyncio")
    level, streams = log.level, [(h, h.stream) for h in log.handlers if isinstance(h, logging.StreamHandler)]
    log.setLevel(logging.WARNING)
    for handler, _ in streams:
        handler.setStream(sys.stderr)
    loop.addFilter(_is_unexpected)
    viewer = logging.getLogger("mujoco.studio.viewer_protocol")
    was, viewer.disabled = viewer.disabled, True  # what ends the viewer is raised, and said once
    try:
        yield
    finally:
        viewer.disabled = was
        loop.removeFilter(_is_unexpected)
        log.setLevel(level)
        for handler, stream in streams:
            handler.setStream(stream)


def _is_unexpected(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    return type(error).__module__.partition(".")[0] != "websockets" and not isinstance(error, ConnectionError)
