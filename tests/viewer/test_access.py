"""Requests that the web viewer answers or refuses."""

import pytest

from rlcli.viewer.access import allowed_hosts, refusal_reason, response_headers

OPEN = {"connection": ["keep-alive, Upgrade"], "upgrade": ["websocket"], "sec-websocket-version": ["13"]}
OWN = {"host": ["localhost:8080"]}


def socket(origin="http://localhost:8080", host="localhost:8080"):
    return {**OPEN, "host": [host], **({} if origin is None else {"origin": [origin]})}


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1:8080", "LOCALHOST:8080"])
@pytest.mark.parametrize("path", ["/", "/index.html", "/model?total_bytes", "/web_client.wasm", "/assets/a[b].ttf"])
def test_own_page_is_answered_for_both_host_names(host, path):
    assert refusal_reason(8080, path, {"host": [host]}) is None
    assert refusal_reason(8080, path, {"host": [host], "origin": [f"http://{host}".lower()]}) is None


@pytest.mark.parametrize("path", ["/ui?sid=a", "/state?sid=a", "/state"])
def test_own_page_may_open_sockets(path):
    assert refusal_reason(8080, path, socket()) is None
    assert refusal_reason(8080, path, socket("http://127.0.0.1:8080", "127.0.0.1:8080")) is None


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:8080", "localhost.evil.example:8080", "127.0.0.1.nip.io:8080", "localhost",
        "localhost:80", "localhost:8081", "localhost.:8080", "[::1]:8080", "[::ffff:127.0.0.1]:8080", "0.0.0.0:8080",
        "127.0.0.2:8080", "2130706433:8080", "0x7f.1:8080", "127.1:8080", "localhost:8080@evil.example", "", " ",
        "localhost:08080", "10.0.0.5:8080", "localhost:8080, evil.example",
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["/", "/model", "/state"])
def test_foreign_host_is_refused(host, path):
    assert refusal_reason(8080, path, {"host": [host]}) is not None
    assert refusal_reason(8080, path, socket(f"http://{host}", host)) is not None


@pytest.mark.parametrize("given", [{}, {"host": []}, {"host": ["localhost:8080", "localhost:8080"]}])
def test_request_needs_exactly_one_host(given):
    assert refusal_reason(8080, "/", given) is not None


@pytest.mark.parametrize(
    "origin",
    [
        "null", "", "http://evil.example", "http://localhost", "http://localhost:3000", "https://localhost:8080",
        "http://127.0.0.1:8080", "http://[::1]:8080", "http://localhost:8080.evil.example", "file://", "ws://localhost:8080",
        "http://localhost:8080/", "http://localhost:8080 http://evil.example", "chrome-extension://abc",
    ],
)  # fmt: skip
def test_foreign_origin_is_refused(origin):
    assert refusal_reason(8080, "/state", socket(origin)) is not None
    assert refusal_reason(8080, "/model", {**OWN, "origin": [origin]}) is not None


def test_socket_without_origin_is_refused():
    assert refusal_reason(8080, "/state", socket(None)) is not None
    assert refusal_reason(8080, "/state", {**OWN, "upgrade": ["websocket"]}) is not None


def test_two_origins_are_refused():
    assert (
        refusal_reason(8080, "/model", {**OWN, "origin": ["http://localhost:8080", "http://localhost:8080"]})
        is not None
    )


@pytest.mark.parametrize("path", ["/drop", "/drop?sid=a", "/", "/model", "/ui/", "/state/x", "/dr%6fp", "//state"])
def test_other_sockets_are_refused(path):
    assert refusal_reason(8080, path, socket()) is not None


@pytest.mark.parametrize(
    "path", ["/../web_server.py", "/assets/..%2f..%2fa.py", "/%2e%2e/a", "/a\\..\\b", "http://x/", "*"]
)
def test_path_traversal_is_refused(path):
    assert refusal_reason(8080, path, OWN) is not None


@pytest.mark.parametrize(
    ("mode", "target", "path", "answered"),
    [
        ("navigate", "document", "/", True),
        ("navigate", "iframe", "/", False),
        ("navigate", "document", "/model", False),
        ("no-cors", "script", "/web_client.js", False),
        ("no-cors", "image", "/favicon.ico", False),
        ("cors", "empty", "/model", False),
    ],
)
@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_foreign_page_may_link_but_not_embed(site, mode, target, path, answered):
    headers = {**OWN, "sec-fetch-site": [site], "sec-fetch-mode": [mode], "sec-fetch-dest": [target]}
    assert (refusal_reason(8080, path, headers) is None) is answered


@pytest.mark.parametrize("site", ["none", "same-origin"])
def test_own_fetches_are_answered(site):
    headers = {**OWN, "sec-fetch-site": [site], "sec-fetch-mode": ["no-cors"], "sec-fetch-dest": ["script"]}
    assert refusal_reason(8080, "/web_client.js", headers) is None


def test_port_80_is_optional_in_host():
    assert set(allowed_hosts(80)) == {"localhost", "localhost:80", "127.0.0.1", "127.0.0.1:80"}
    assert refusal_reason(80, "/state", {**OPEN, "host": ["localhost"], "origin": ["http://localhost"]}) is None


def test_content_security_policy_allows_only_own_server():
    policy = response_headers(8080)["Content-Security-Policy"]
    named = {word for part in policy.split(";") for word in part.split()[1:]}
    assert {word for word in named if "//" in word} == {"ws://localhost:8080", "ws://127.0.0.1:8080"}
    assert "*" not in named
    assert "frame-ancestors 'none'" in policy


@pytest.mark.parametrize("name", ["host", "origin", "sec-fetch-site", "sec-fetch-mode", "sec-fetch-dest", "upgrade"])
def test_security_header_that_appears_twice_is_refused(name):
    values = {"host": "localhost:8080", "origin": "http://localhost:8080", "upgrade": "websocket"}
    headers = {**socket(), name: [values.get(name, "same-origin")] * 2}
    assert refusal_reason(8080, "/state", headers) == f"the request has the header {name} twice"
