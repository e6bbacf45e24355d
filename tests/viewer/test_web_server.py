"""Server of `play --viewer web`: requests of other pages and programs, sent without a browser."""

import contextlib
import json
import signal
import socket
import time
from pathlib import Path

import pytest
from support.viewer_process import PATIENCE, Playing

START = ("cartpole", "--policy", "zero", "--viewer", "web", "--num-envs", 2)
UPGRADE = (
    "Connection: Upgrade",
    "Upgrade: websocket",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)


@pytest.fixture(scope="module")
def playing(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    with Playing(*START, "--port", 0, SSH_CONNECTION="10.0.0.7 50000 10.0.0.9 22", RLCLI_RUNS_DIR=str(folder)) as one:
        yield one


def ask(playing, path, *lines):
    """Send a request with these header lines; return the head and the first bytes of the body of the response."""
    text = "\r\n".join([f"GET {path} HTTP/1.1", *lines, "", ""])
    with socket.create_connection(("127.0.0.1", playing.port), timeout=PATIENCE) as connection:
        connection.sendall(text.encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            part = connection.recv(65536)
            if not part:
                break
            answer += part
    return answer.decode("latin-1")


def status(answer):
    return int(answer.split()[1])


def test_address_and_ssh_tunnel_are_printed(playing):
    assert f"open {playing.url} in a browser" in playing.err
    assert "viewer: web (--viewer is given)" in playing.err
    (line,) = [line for line in playing.err.splitlines() if "ssh -N" in line]
    assert f"-L {playing.port}:127.0.0.1:{playing.port} " in line
    assert "@10.0.0.9" in line


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
@pytest.mark.parametrize("path", ["/", "/web_client.js", "/model?total_bytes", "/assets/pbr.filamat"])
def test_own_page_is_served_with_headers(playing, name, path):
    answer = ask(playing, path, f"Host: {name}:{playing.port}")
    head = answer.partition("\r\n\r\n")[0].lower()
    assert status(answer) == 200
    assert "access-control-allow-origin" not in head
    assert head.count("cross-origin-resource-policy: same-origin") == 1
    assert "frame-ancestors 'none'" in head


@pytest.mark.parametrize("path", ["/state?sid=a", "/ui?sid=a"])
def test_own_page_opens_sockets(playing, path):
    own = (f"Host: {playing.host}", f"Origin: http://{playing.host}")
    assert status(ask(playing, path, *own, *UPGRADE)) == 101


STRANGERS = {
    "a foreign host": ("Host: evil.example:{port}",),
    "a name that leads here": ("Host: 127.0.0.1.nip.io:{port}", "Origin: http://127.0.0.1.nip.io:{port}"),
    "an address of another form": ("Host: [::1]:{port}", "Origin: http://[::1]:{port}"),
    "another port": ("Host: 127.0.0.1:1", "Origin: http://127.0.0.1:1"),
    "no port": ("Host: 127.0.0.1",),
    "no host": (),
    "two hosts": ("Host: 127.0.0.1:{port}", "Host: evil.example"),
    "a foreign origin": ("Host: 127.0.0.1:{port}", "Origin: http://evil.example"),
    "another server here": ("Host: 127.0.0.1:{port}", "Origin: http://127.0.0.1:3000"),
    "an opaque origin": ("Host: 127.0.0.1:{port}", "Origin: null"),
    "an image in another page": ("Host: 127.0.0.1:{port}", "Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: no-cors"),
}


@pytest.mark.parametrize("upgrade", [(), UPGRADE], ids=["page", "socket"])
@pytest.mark.parametrize("lines", STRANGERS.values(), ids=list(STRANGERS))
def test_foreign_requests_are_refused(playing, lines, upgrade):
    for path in ("/", "/model", "/state?sid=a"):
        answer = ask(playing, path, *(line.format(port=playing.port) for line in lines), *upgrade)
        assert status(answer) in (400, 403), answer
        assert "mujoco" not in answer.lower()


def test_socket_without_origin_is_refused(playing):
    assert status(ask(playing, "/state?sid=a", f"Host: {playing.host}", *UPGRADE)) == 403


@pytest.mark.parametrize("upgrade", [(), UPGRADE], ids=["page", "socket"])
def test_model_upload_is_refused(playing, upgrade):
    own = (f"Host: {playing.host}", f"Origin: http://{playing.host}")
    assert status(ask(playing, "/drop?sid=a", *own, *upgrade)) in (403, 426)
    assert status(ask(playing, "/drop?sid=a", *own, *UPGRADE)) == 403


@pytest.mark.parametrize(
    "path", ["/../web_server.py", "/..%2fweb_server.py", "/assets/../../../__init__.py", "/etc/passwd"]
)
def test_local_files_are_not_served(playing, path):
    assert status(ask(playing, path, f"Host: {playing.host}")) in (403, 404)


def listening(process):
    """Return the addresses at which a process listens, in the format of the kernel."""
    links = [link.readlink().name for link in Path(f"/proc/{process}/fd").iterdir() if link.is_symlink()]
    inodes = {name[8:-1] for name in map(str, links) if name.startswith("socket:[")}
    found = []
    for table in ("tcp", "tcp6"):
        file = Path(f"/proc/{process}/net/{table}")
        for line in file.read_text().splitlines()[1:] if file.exists() else []:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                found.append((table, *fields[1].split(":")))
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="only Linux tells who listens where")
def test_server_listens_only_on_loopback(playing):
    found = listening(playing.process.pid)
    assert (f"{playing.port:04X}") in [port for _, _, port in found]
    assert {(table, address) for table, address, _ in found} == {("tcp", "0100007F")}


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="only Linux tells who listens where")
def test_inner_listener_accepts_only_own_process(playing):
    inner = [int(port, 16) for _, _, port in listening(playing.process.pid) if int(port, 16) != playing.port]
    assert len(inner) == 1
    with socket.create_connection(("127.0.0.1", inner[0]), timeout=PATIENCE) as connection:
        connection.sendall(b"POST / HTTP/1.1\r\n\r\n")
        assert ended(connection)
    assert status(ask(playing, "/", f"Host: {playing.host}")) == 200


def ended(connection):
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def test_port_in_use_error_has_hint(playing, capfd, monkeypatch, tmp_path):
    from rlcli.cli.app import main

    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    assert main(["play", *map(str, START), "--port", str(playing.port)]) == 10
    out, err = capfd.readouterr()
    assert out == ""
    assert f"port {playing.port} is in use" in err
    assert "--port 0" in err


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_stopped_server_frees_port_and_stdout_is_one_document(tmp_path, stop):
    with Playing(*START, "--port", 0, "--json", RLCLI_RUNS_DIR=str(tmp_path)) as one:
        assert status(ask(one, "/", f"Host: {one.host}")) == 200
        one.process.send_signal(stop)
        code = one.process.wait(timeout=PATIENCE)
        assert not one.answers()
    if stop == signal.SIGINT:
        assert code == 130
        assert json.loads(one.out)["error"]["kind"] == "stopped"
        assert "error: interrupted" in one.err
    assert "Traceback" not in one.err


def frame(opcode, content):
    """Return a masked WebSocket frame of a client."""
    return bytes([0x80 | opcode, 0x80 | len(content), 0, 0, 0, 0]) + content


@pytest.mark.parametrize("path", ["/ui?sid=a", "/state?sid=a"])
@pytest.mark.parametrize(("opcode", "content"), [(1, b"hello"), (1, b""), (1, b'{"a": 1}'), (2, b""), (2, b"\0\1")])
def test_unexpected_message_prints_nothing(playing, path, opcode, content):
    own = (f"Host: {playing.host}", f"Origin: http://{playing.host}")
    before, answer = playing.err, b""
    with socket.create_connection(("127.0.0.1", playing.port), timeout=5) as connection:
        connection.sendall("\r\n".join([f"GET {path} HTTP/1.1", *own, *UPGRADE, "", ""]).encode())
        connection.sendall(frame(opcode, content))
        deadline = time.monotonic() + 5
        with contextlib.suppress(TimeoutError):  # a message that is expected leaves the connection open
            while (part := connection.recv(65536)) and time.monotonic() < deadline:
                answer += part
    if path.startswith("/ui") and opcode == 1:
        assert (1003).to_bytes(2, "big") + b"unexpected message" in answer
    assert playing.err == before
    assert status(ask(playing, "/", f"Host: 127.0.0.1:{playing.port}")) == 200


@pytest.mark.slow
def test_connection_without_a_complete_request_is_closed(playing):
    beginnings = ["", "GET ", "GET / HTTP/1.1\r\n", f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{playing.port}\r\nX: "]
    connections = [socket.create_connection(("127.0.0.1", playing.port), timeout=PATIENCE) for _ in range(100)]
    for number, connection in enumerate(connections):
        connection.sendall(beginnings[number % len(beginnings)].encode())
    for connection in connections:
        while connection.recv(65536):  # an answer, perhaps, and then the end; without it a timeout
            pass
        connection.close()
    assert status(ask(playing, "/", f"Host: 127.0.0.1:{playing.port}")) == 200
