"""Access control for MuJoCo's web viewer: the server answers only its own page, only on this machine, prints nothing.

Without this module, MuJoCo's web viewer (`mujoco.studio`, private and new in 4.0) listens on every interface, answers
requests of any page, and loads models that a page sends. While a viewer runs, this module replaces the few functions of
that package that open sockets and answer requests. `verify_refusals` then sends requests that the server must refuse.
"""

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
from unittest import mock

import mujoco

from rlcli.errors import DependencyError, MachineError, one_line, pip_install
from rlcli.viewer.access import refusal_reason, response_headers

_log = logging.getLogger(__name__)
_REQUIRED_NAMES = {
    "web_viewer": ("WebViewer", "web_server", "_print_url_banner"),
    "web.web_server": ("serve", "bind_public_socket", "bind_loopback_socket", "WebServer", "Response", "Headers"),
    "web.headless_ui": ("HeadlessUi",),
    "web.state_payload": ("MAX_EXTRA_GEOMS",),
    "launch_thread": ("make_thread_endpoints",),
    "viewer_protocol": ("ViewerConfig", "run_viewer_loop"),
    "messages": (
        *("StateSnapshot", "ModelEvent", "PostModelEvent", "ExitEvent", "UpdateEvent", "BuildGuiEvent", "handler"),
    ),
    "plugin": ("ViewerPlugin", "ViewerInitEvent", "ThemeEvent"),
    "ux": ("UxState", "setup_theme", "configure_docking_layout", "view_gizmo_gui", "rendering_gui", "groups_gui"),
    "app.inputs": ("handle_mouse_events", "handle_vis_options_keyboard_events", "handle_camera_select_keyboard_events"),
    "dear_imgui.dear_imgui": ("Begin", "Button", "Combo", "SliderFloat", "IsKeyChordPressed"),
}
"""Module of `mujoco.studio` -> names of the module that rlcli uses."""
_MAX_MESSAGE_BYTES = 2**20
"""Largest message that the server accepts from a browser [bytes]."""
_UNSUPPORTED_DATA = 1003
"""Status code (RFC 6455) with which a WebSocket is closed if the type of its data is not accepted."""
_REQUEST_S = 10.0
"""Time after which the server closes a connection without a complete request [s]."""


def import_web_viewer() -> SimpleNamespace:
    """Import MuJoCo's web viewer; return its modules as attributes, named by the last parts of the modules' names.

    Raises:
        DependencyError: if the installed MuJoCo has no web viewer, or a version of it that is not supported.
    """
    modules, missing = {}, []
    for name, attributes in _REQUIRED_NAMES.items():
        try:
            module = importlib.import_module(f"mujoco.studio.{name}")
        except Exception as error:  # the wheel has no viewer, or another one whose import may raise any error
            raise incompatible_viewer(f"{type(error).__name__}: {error}") from None
        missing += [f"{name}.{attribute}" for attribute in attributes if not hasattr(module, attribute)]
        modules[name.rpartition(".")[2]] = module
    if not missing:
        expected = {"config", "endpoint", "model", "plugins", "camera"}
        absent = expected - set(inspect.signature(modules["web_viewer"].WebViewer).parameters)
        missing += [f"web_viewer.WebViewer({name})" for name in sorted(absent)]
    if missing:
        raise incompatible_viewer(f"mujoco.studio has no {', '.join(missing[:5])}")
    return SimpleNamespace(**modules)


def incompatible_viewer(why: str) -> DependencyError:
    """Return the error for an installed MuJoCo whose web viewer is not supported; `why` is the reason."""
    return DependencyError(
        f"the web viewer does not work with the installed mujoco {mujoco.__version__}: {' '.join(why.split())}",
        hint=f"{pip_install('mujoco==4.0.*')}, or use --video FILE.mp4, or --viewer none",
    )


def listen(port: int, socket_class: type[socket.socket] = socket.socket) -> socket.socket:
    """Return a listening socket on the loopback interface.

    Args:
        port: the port; 0: any free port.
        socket_class: class of the socket.

    Raises:
        MachineError: if the port is in use, or not allowed.
    """
    listener = socket_class(socket.AF_INET, socket.SOCK_STREAM)
    if os.name == "posix":  # otherwise the port stays in use for a minute after the server has ended
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
        listener.listen()
    except OSError as error:
        listener.close()
        in_use = error.errno == errno.EADDRINUSE
        problem = "is in use, perhaps by another viewer" if in_use else f"cannot be opened: {error.strerror}"
        raise MachineError(f"port {port} {problem}", hint="give --port 0 for a free port") from None
    return listener


@contextlib.contextmanager
def secured_server(studio: SimpleNamespace, listener: socket.socket) -> Iterator[None]:
    """Replace functions of MuJoCo's web viewer during a `with` block.

    A viewer that starts in the block listens on `listener`, refuses requests of other pages, and prints nothing.

    Args:
        studio: the viewer's modules, from `import_web_viewer`.
        listener: a listening socket, from `listen`.
    """
    server, viewer = studio.web_server, studio.web_viewer
    port = listener.getsockname()[1]
    replacements: list[tuple[Any, str, Any]] = [
        (server, "serve", _serve_with_checks(server, port)),
        (server, "bind_public_socket", lambda *_: listener),
        (server, "bind_loopback_socket", lambda *_: listen(0, _OwnProcessListener)),
        (viewer, "_print_url_banner", lambda *_: None),
        (viewer, "print", lambda *_, **__: None),
    ]
    with _quiet(), contextlib.ExitStack() as stack:
        for module, name, value in replacements:
            stack.enter_context(mock.patch.object(module, name, value, create=True))
        yield


def verify_refusals(port: int) -> None:
    """Check that the running server answers a request for its page, and refuses requests of other pages.

    Raises:
        DependencyError: if the server does not answer, or with another status than expected.
    """
    own = f"127.0.0.1:{port}"
    requests = {
        "for its page": ({"Host": own}, 200),
        "with a foreign Host": ({"Host": f"rlcli.invalid:{port}"}, 403),
        "with a foreign Origin": ({"Host": own, "Origin": "http://rlcli.invalid"}, 403),
    }
    for name, (headers, expected) in requests.items():
        status = _status(port, headers)
        if status != expected:
            raise incompatible_viewer(f"its server answers a request {name} with status {status}, expected {expected}")


def _status(port: int, headers: dict[str, str]) -> int:
    """Return the HTTP status of the server's answer to a GET request with these headers."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as connection:
        try:
            connection.request("GET", "/", headers=headers)
            return connection.getresponse().status
        except (OSError, http.client.HTTPException) as error:
            raise incompatible_viewer(f"its server does not answer: {error}") from None


def _serve_with_checks(server: Any, port: int) -> Any:
    """Return a replacement for `websockets.serve`.

    The replacement refuses forbidden requests before the viewer handles them, and sets the headers of every response.
    """
    serve, own_headers = server.serve, response_headers(port)

    def serve_checked(
        handler: Any, *arguments: Any, process_request: Any, process_response: Any, **settings: Any
    ) -> Any:
        async def handle(connection: Any) -> None:
            """Handle a connection; close it, without a printed error, if the viewer cannot handle a message."""
            try:
                await handler(connection)
            except Exception as error:
                _log.debug("the web viewer closes a connection: %s", one_line(error, 200))
                await connection.close(_UNSUPPORTED_DATA, "unexpected message")

        def check(connection: Any, request: Any) -> Any:
            """Return the response 403 for a forbidden request; let the viewer answer other requests."""
            headers: dict[str, list[str]] = {}
            for name, value in request.headers.raw_items():
                headers.setdefault(name.lower(), []).append(value)
            reason = refusal_reason(port, request.path, headers)
            if getattr(request, "method", "GET") != "GET":
                reason = "the viewer answers only GET requests"
            if reason is not None:
                body = f"refused: {reason}\n".encode()
                refusal = server.Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
                return server.Response(403, "Forbidden", refusal, body)
            return process_request(connection, request)

        def respond(connection: Any, request: Any, response: Any) -> Any:
            """Set the headers of a response, also of a refusal, so that no other page can read the response."""
            response = process_response(connection, request, response) or response
            for name in ("Access-Control-Allow-Origin", *own_headers):
                if name in response.headers:
                    del response.headers[name]
            response.headers.update(own_headers)
            return response

        settings |= {"max_size": _MAX_MESSAGE_BYTES, "open_timeout": _REQUEST_S, "close_timeout": _REQUEST_S}
        return serve(handle, *arguments, **settings, process_request=check, process_response=respond)

    return serve_checked


class _OwnProcessListener(socket.socket):
    """Socket that accepts only connections of this process.

    MuJoCo draws the controls of the page in this process, and sends them to its server over the loopback interface,
    to which every local user can connect.
    """

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; return the socket and the address of the peer.

        Raises:
            ConnectionAbortedError: if another process has opened the connection, which is then closed.
        """
        connection, peer = super().accept()
        if _is_own_socket(peer):
            return connection, peer
        connection.close()
        raise ConnectionAbortedError


def _is_own_socket(peer: object) -> bool:
    """Return whether this process has a socket with the address `peer`; True if the system has no `/dev/fd`."""
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
    """Send the warnings of MuJoCo's web viewer to stderr during a `with` block, and discard its other messages.

    Errors of connections that a browser closes are discarded, too.
    """
    log, loop = logging.getLogger("WebServer"), logging.getLogger("asyncio")
    level, streams = log.level, [(h, h.stream) for h in log.handlers if isinstance(h, logging.StreamHandler)]
    log.setLevel(logging.WARNING)
    for handler, _ in streams:
        handler.setStream(sys.stderr)
    loop.addFilter(_is_unexpected)
    viewer = logging.getLogger("mujoco.studio.viewer_protocol")
    # errors of the viewer are raised; without this line they would also be printed
    was_disabled, viewer.disabled = viewer.disabled, True
    try:
        yield
    finally:
        viewer.disabled = was_disabled
        loop.removeFilter(_is_unexpected)
        log.setLevel(level)
        for handler, stream in streams:
            handler.setStream(stream)


def _is_unexpected(record: logging.LogRecord) -> bool:
    """Return whether a log record is not about a connection that a browser has closed."""
    error = record.exc_info[1] if record.exc_info else None
    return type(error).__module__.partition(".")[0] != "websockets" and not isinstance(error, ConnectionError)
