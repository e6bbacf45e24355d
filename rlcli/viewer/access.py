"""Access control of the web viewer: only the viewer's own page, opened on this machine, may send requests.

Every page that is open in the user's browser can send requests to a server on the loopback interface. But a page cannot
change the headers that the browser adds: `Host` (the name of the server), `Origin` (the page that sends the request)
and `Sec-Fetch-*`. A request is answered only if these headers name the viewer's own page.
"""

from collections.abc import Mapping, Sequence

SOCKETS = ("/ui", "/state")
"""Paths that accept a WebSocket; without `/drop`, through which a browser could load a model."""

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:;"
        " worker-src 'self' blob:; connect-src 'self' {sockets} blob: data:; img-src 'self' blob: data:;"
        " style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; form-action 'none';"
        " frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Headers of every response: the page loads nothing from other servers, and no other page may embed or read it."""


def response_headers(port: int) -> dict[str, str]:
    """Return the headers (name -> value) that the server at `port` adds to every response."""
    sockets = " ".join(f"ws://{host}" for host in allowed_hosts(port))
    return {name: value.replace("{sockets}", sockets) for name, value in HEADERS.items()}


def allowed_hosts(port: int) -> tuple[str, ...]:
    """Return the allowed values of the header `Host`: this machine at `port`, also through an SSH tunnel."""
    names = ("localhost", "127.0.0.1")
    return (*(f"{name}:{port}" for name in names), *(names if port == 80 else ()))


def refusal_reason(port: int, path: str, request_headers: Mapping[str, Sequence[str]]) -> str | None:
    """Return why a request to the web viewer must be refused, or None if it may be answered.

    Args:
        port: the port of the server.
        path: the path of the request, with its query (the part after `?`).
        request_headers: header name in lower case -> its values.
    """
    for name, values in request_headers.items():
        if len(values) > 1 and (name in ("host", "origin", "upgrade") or name.startswith("sec-fetch-")):
            return f"the request has the header {name} twice"
    host = [value.lower() for value in request_headers.get("host", ())]
    if not host or host[0] not in allowed_hosts(port):
        return f"the Host header does not name this machine; open http://localhost:{port}/"
    route = path.partition("?")[0]
    if not path.startswith("/") or ".." in route or "\\" in route or "%" in route:
        return f"the viewer has no such path; open http://localhost:{port}/"
    upgrades = any("upgrade" in value.lower() for value in request_headers.get("connection", ()))
    is_websocket = upgrades or "upgrade" in request_headers
    if is_websocket and route not in SOCKETS:
        return "the viewer has no WebSocket at this path"
    origin = [value.lower() for value in request_headers.get("origin", ())]
    own = f"http://{host[0]}"
    # browsers always send Origin with a WebSocket, but not with every request for a page
    if (is_websocket and not origin) or any(value != own for value in origin):
        return "another page sent the request"
    site, mode, target = (
        (*request_headers.get(f"sec-fetch-{name}", ()), "")[0].lower() for name in ("site", "mode", "dest")
    )
    # a click on a link of another page may open ours: that page learns nothing from the new document
    is_link = mode == "navigate" and target == "document" and route in ("/", "/index.html") and not is_websocket
    if site not in ("", "same-origin", "none") and not is_link:
        return "another page sent the request"
    return None
