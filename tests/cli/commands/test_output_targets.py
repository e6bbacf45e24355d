"""Files that the user names for output: a pipe, a socket, a device or a folder is refused before any work."""

import os
import resource
import socket
import stat

import pytest

pytestmark = pytest.mark.usefixtures("empty_folder")


def expect_code(result, code):
    assert result.code == code, result.err
    return result


COMMANDS = {
    "eval --record": ("eval", "cartpole", "--record", "out"),
    "eval --record-mode": ("eval", "cartpole", "--record", "out-of", "--record-mode", "separate"),
    "play --record": ("play", "cartpole", "--policy", "zero", "--record", "out"),
    "play --video": ("play", "cartpole", "--policy", "zero", "--video", "out.gif"),
    "replay --video": ("replay", "episodes.safetensors", "--video", "out.gif"),
    "autopsy --video": ("autopsy", "latest", "1", "--video", "out.gif"),
    "export onnx": ("export", "cartpole", "--output", "out.onnx"),
    "export numpy": ("export", "cartpole", "--format", "numpy", "--output", "out.py"),
    "export torch": ("export", "cartpole", "--format", "torch", "--output", "out.pt2"),
    "stress": ("stress", "cartpole", "--sweep", "gravity=1", "-o", "out.png"),
    "plot": ("plot", "latest", "-o", "out.svg"),
    "report": ("report", "latest", "-o", "out.html"),
    "bench": ("bench", "cartpole", "--save-preset", "out.yaml", "--overwrite"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_output_to_a_pipe_is_refused_before_any_work(cli, tmp_path, name):
    words = COMMANDS[name]
    file = tmp_path / next((word for word in words if word.startswith("out")), "").replace("out-of", "out-of-failed")
    os.mkfifo(file)
    error = expect_code(cli(*words), 2).err
    assert f"cannot write {file.name}: it is a pipe" in error
    assert "hint: give the name of a new or a regular file" in error
    assert stat.S_ISFIFO(file.stat().st_mode)


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="Linux: nobody can write a file there, whatever its rights")
@pytest.mark.parametrize("name", COMMANDS)
def test_output_to_a_folder_that_takes_no_files_is_refused_before_any_work(cli, name):
    words = [f"/proc/{word}" if word.startswith("out") else word for word in COMMANDS[name]]
    error = expect_code(cli(*words), 10).err
    assert error.startswith("error: cannot write /proc/out")
    assert "hint: choose another folder" in error


def test_output_to_a_link_to_a_socket_is_refused(cli, tmp_path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("s")
        (tmp_path / "link.html").symlink_to("s")
        assert (
            "cannot write link.html: it is a socket" in expect_code(cli("report", "latest", "-o", "link.html"), 2).err
        )
    assert (tmp_path / "link.html").is_symlink()


@pytest.mark.parametrize(
    "command",
    [
        ("eval", "cartpole", "--policy", "zero", "--episodes", 8),
        ("play", "cartpole", "--policy", "zero", "--viewer", "none", "--num-envs", 8),
        ("play", "cartpole", "--policy", "zero", "--viewer", "none", "--num-envs", 8, "--env", 2, "--episode", 0),
    ],
    ids=["eval", "play", "one episode"],
)
def test_recording_that_cannot_be_written_does_not_take_the_results_with_it(cli, command):
    whole = cli(*command)
    assert whole.code == 0, whole.err
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        ended = [cli(*command, "--record", "rec.npz", *more) for more in ((), ("--json",))]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    text, document = ended
    assert text.code == document.code == 10
    assert text.out == whole.out
    assert "error: cannot write rec.npz: File too large" in text.err
    assert "`ulimit -f`" in text.err
    assert document.json["recorded"] == []
    assert "error" not in document.json
    assert os.listdir() == []
