"""Who may talk to the browser's viewer: its own page, opened on this machine, and nobody else.

A server on the loopback interface is within reach of every page that the user's browser has open. What those cannot do
is name themselves: the browser says in `Host` which name it was told to connect to, in `Origin` which page asks, and in
`Sec-Fetch-*` how. So a request is answered only if all that it says is of our own page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

SOCKETS = ("/ui", "/state")
"""Paths that a WebSocket may be opened to; models are not taken from browsers (`/drop`)."""

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
"""What every answer says: nothing is fetched from elsewhere, and no other page may show or read this one."""


def headers(port: int) -> dict[str, str]:
    """The headers of every answer of the server at `port`."""
    sockets = " ".join(f"ws://{host}" for host in hosts(port))
    return {name: value.replace("{sockets}", sockets) for name, value in HEADERS.items()}


def hosts(port: int) -> tuple[str, ...]:
    """What a browser on this machine, or at the other end of a tunnel, says in `Host`."""
    names = ("localhost", "127.0.0.1")
    return (*(f"{name}:{port}" for name in names), *(names if port == 80 else ()))


def refusal(port: int, path: str, given: Mapping[str, Sequence[str]]) -> str | None:
    """Why a request is not answered; None: it is.

    Args:
        port: of the server.
        path: what was asked for, with its query.
        given: header, in lower case -> its values.
    """
    host = [value.lower() for value in given.get("host", ())]
    if len(host) != 1 or host[0] not in hosts(port):
        return "not a name of this machine"
    place = path.partition("?")[0]
    if not path.startswith("/") or ".." in place or "\\" in place or "%" in place:
        return "no such path"
    opens = any("upgrade" in value.lower() for value in given.get("connection", ())) or "upgrade" in given
    if opens and place not in SOCKETS:
        return "no such socket"
    origin = [value.lower() for value in given.get("origin", ())]
    own = f"http://{host[0]}"
    if (opens and not origin) or any(value != own for value in origin) or len(origin) > 1:
        return "another page"
    site, mode, target = ((*given.get(f"sec-fetch-{name}", ()), "")[0].lower() for name in ("site", "mode", "dest"))
    followed = mode == "navigate" and target == "document" and place in ("/", "/index.html") and not opens
    if site not in ("", "same-origin", "none") and not followed:
        return "another page"
    return None
