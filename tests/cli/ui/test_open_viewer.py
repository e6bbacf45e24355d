"""Choice of the viewer of `play`, invalid combinations of options, and missing display, OpenGL or viewer."""

import contextlib
import hashlib
import importlib
import inspect
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from support.fenced import REPOSITORY
from support.worlds import CRITTER, CRITTER_TASK

from rlcli.cli.commands import play
from rlcli.cli.ui import open_viewer
from rlcli.errors import DependencyError, MachineError
from rlcli.viewer.protocol import VIEWERS, Viewer

pytestmark = pytest.mark.usefixtures("empty_folder")

ZERO = ("play", "cartpole", "--policy", "zero", "--num-envs", 2)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def at_a_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stdin", Terminal())
    monkeypatch.setattr(sys, "stdout", Terminal())


def names(*arguments, **settings):
    return [name for name, _ in open_viewer.choose_viewers(*arguments, **{"headless": False, **settings})]


def test_display_selects_native_viewer(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    assert names("auto", None) == ["native", "none"]


def test_terminal_without_display_selects_web_viewer(monkeypatch):
    at_a_terminal(monkeypatch)
    assert names("auto", None) == ["web", "none"]


def test_web_viewer_follows_native_viewer_in_terminal(monkeypatch):
    at_a_terminal(monkeypatch)
    monkeypatch.setenv("DISPLAY", ":0")
    assert names("auto", None) == ["native", "web", "none"]


def test_script_without_display_selects_no_viewer():
    assert names("auto", None) == ["none"]


@pytest.mark.parametrize("display", ["", ":0"])
def test_headless_selects_no_viewer(monkeypatch, display):
    at_a_terminal(monkeypatch)
    monkeypatch.setenv("DISPLAY", display)
    assert names("auto", None, headless=True) == ["none"]


def test_port_selects_web_viewer(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    assert names("auto", 9000) == ["web"]


@pytest.mark.parametrize("viewer", [*(name for name in VIEWERS if name != "native"), "none"])
def test_explicit_viewer_is_chosen(viewer):
    assert open_viewer.choose_viewers(viewer, None, headless=True) == [(viewer, "--viewer is given")]


@pytest.mark.parametrize("place", VIEWERS.values())
def test_viewers_have_protocol_parameters(place):
    module, _, function = place.partition(":")
    run = getattr(importlib.import_module(module), function)
    expected = [name for name in inspect.signature(Viewer.__call__).parameters if name != "self"]
    assert list(inspect.signature(run).parameters) == expected


def test_help_and_pages_name_every_viewer():
    guides = REPOSITORY / "docs" / "guides"
    for name in open_viewer.CHOICES:
        assert name in play.command.__doc__.partition("viewer: ")[2].partition("port: ")[0]
        assert f"| `{name}`" in (guides / "play.md").read_text(encoding="utf-8")
    assert f"auto, {', '.join(VIEWERS)}, none" in (guides / "settings.md").read_text(encoding="utf-8")


def test_play_prints_viewer_and_reason(cli):
    done = cli(*ZERO)
    assert done.code == 0
    assert (
        "viewer: none (no display, and not started from a terminal; --viewer web shows the policy in the browser)"
        in done.err
    )
    assert "viewer: none (--viewer is given)" in cli(*ZERO, "--viewer", "none").err
    assert cli(*ZERO, "--json").json["video"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--viewer", "wbe"), "did you mean 'web'"),
        (("--viewer", "browser"), ", ".join(("auto", *VIEWERS, "none"))),
        *(
            (("--viewer", name, "--port", "0"), "--port sets the port of the web viewer, which is not opened here")
            for name in (*VIEWERS, "none")
            if name != "web"
        ),
        (("--viewer", "web", "--port", "70000"), "'--port'"),
        (("--viewer", "web", "--video", "x.gif"), "leave out --viewer"),
        (
            ("--port", "0", "--video", "x.gif"),
            "--port sets the port of the web viewer, which is not opened here; hint: leave out --port",
        ),
        (("--show", "3"), "above the number of environments, 2; hint: --num-envs 3"),
        (("--show", "0"), "'--show'"),
        (("--command", "vx"), "--command 'vx' is not NAME=NUMBER"),
        (("--command", "vx=fast"), "--command 'vx=fast' is not NAME=NUMBER"),
        (("--command", ""), "there is an empty word after --command"),
        (("--command", "vx=1"), "the task has no command 'vx'; hint: leave out --command"),
        (("--command", "vx=1", "--record", "x.safetensors"), "leave out --record or --command"),
    ],
)
def test_contradicting_flags_are_usage_errors(cli, arguments, message):
    done = cli(*ZERO, *arguments)
    assert done.code == 2
    assert message in done.err.replace("\nhint: ", "; hint: ")
    assert done.out == ""
    assert not list(Path().iterdir())


@pytest.fixture
def walker(tmp_path):
    """A task with a velocity command, as a folder."""
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {
        "velocity": {"func": "uniform_velocity", "resampling_time_s": [0.1, 0.2], "lin_vel_x": [0.9, 1.0]}
    }
    task["rewards"] = {"command": {"func": "command", "weight": 1.0}}
    folder = tmp_path / "walker"
    folder.mkdir()
    (folder / "critter.xml").write_text(CRITTER)
    (folder / "terms.py").write_text(
        "def command(env):\n    '''The command. (num_envs,)'''\n"
        "    return env.command_manager.get_command('velocity')[:, 0]\n"
    )
    (folder / "task.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    return "./walker"


def test_command_is_held_without_viewer(cli, walker):
    arguments = ("play", walker, "--policy", "zero", "--viewer", "none", "--json")
    drawn, held = (cli(*arguments, *more).json for more in ((), ("--command", "vx=-2.0,wz=0", "--command", "vy=0.5")))
    assert drawn["reward_terms"]["command"]["mean"] > 0.0
    assert held["reward_terms"]["command"]["mean"] / held["length"]["mean"] == pytest.approx(-2.0 * 0.02, rel=0.05)


def test_unknown_command_lists_valid_ones(cli, walker):
    done = cli("play", walker, "--policy", "zero", "--command", "vz=1")
    assert done.code == 2
    assert "commands: vx, vy, wz" in done.err


# --- missing display, viewer or OpenGL ---


def test_macos_without_mjpython_names_command(cli, monkeypatch):
    import mujoco.viewer

    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(mujoco.viewer, "_MJPYTHON", None)
    done = cli(*ZERO, "--viewer", "native")
    assert done.code == 10
    assert "mjpython -m rlcli play" in done.err
    auto = cli(*ZERO)
    assert auto.code == 0
    assert "viewer: native does not work: " in auto.err
    assert "mjpython" in auto.err
    assert "viewer: none (no window" in auto.err
    assert "episodes" in auto.out


def test_macos_without_mjpython_falls_back_to_web_viewer(cli, monkeypatch):
    import mujoco.viewer

    from rlcli.viewer import web

    opened = []
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(mujoco.viewer, "_MJPYTHON", None)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(open_viewer, "choose_viewers", lambda *_, **__: [("native", "a"), ("web", "b"), ("none", "c")])
    monkeypatch.setattr(web, "run", lambda player, **settings: opened.append(settings["port"]))
    assert cli(*ZERO).code == 0
    assert opened == [8080]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs X")
def test_unreachable_display_fails_at_once(start, environment):
    done = start(*ZERO, "--viewer", "native", env={**environment, "DISPLAY": ":4242"})
    out, err = done.communicate(timeout=120)
    assert done.returncode == 10
    assert "the window cannot be opened" in err
    assert "Traceback" not in err
    assert out == ""


@contextlib.contextmanager
def without(module, name):
    kept = getattr(module, name)
    delattr(module, name)
    try:
        yield
    finally:
        setattr(module, name, kept)


@pytest.mark.parametrize(
    ("module", "name"),
    [("web_viewer", "WebViewer"), ("web.web_server", "bind_public_socket"), ("messages", "StateSnapshot")],
)
def test_incompatible_mujoco_viewer_is_dependency_error(cli, module, name):
    with without(importlib.import_module(f"mujoco.studio.{module}"), name):
        done = cli(*ZERO, "--viewer", "web", "--port", "0")
    assert done.code == 7
    assert f"{module}.{name}" in done.err
    assert "mujoco==4.0" in done.err
    assert done.out == ""


def test_mujoco_without_web_viewer_is_dependency_error(cli, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.studio.web_viewer", None)
    done = cli(*ZERO, "--viewer", "web", "--port", "0")
    assert done.code == 7
    assert "the browser's viewer does not work with the installed mujoco" in done.err


def test_server_without_access_checks_is_stopped():
    """If another version of MuJoCo served requests without the access checks, the server must not start."""
    code = (
        "import sys; from rlcli.viewer import secured_web_server as server; from rlcli.cli.app import main\n"
        "server._serve_with_checks = lambda server, port: server.serve\n"
        "sys.exit(main(['play', 'cartpole', '--policy', 'zero', '--viewer', 'web', '--port', '0', '--num-envs', '1']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 7
    assert "answers a request with a foreign Host with status 200, expected 403" in done.stderr
    assert done.stdout == ""


def test_failing_viewer_falls_back_to_next(monkeypatch, capsys):
    tried = []

    def fail(session, name, *_):
        tried.append(name)
        raise MachineError("no window") if name == "native" else DependencyError("no browser")

    monkeypatch.setattr(open_viewer, "_open", fail)
    settings = {"port": None, "drawn": 1}
    choices = [("native", "a"), ("web", "b"), ("none", "c")]
    assert open_viewer.show(None, choices, **settings) is False
    assert tried == ["native", "web"]
    with pytest.raises(DependencyError):
        open_viewer.show(None, choices[:2], **settings)


# --- drawing without a display ---

HIDING = """
import sys

class Hidden:
    def find_spec(name, *_):
        if name.removeprefix("mujoco.") in {hidden!r}:
            raise ImportError(name + " is not here")

sys.meta_path.insert(0, Hidden)
from rlcli.cli.app import main
sys.exit(main({words!r}))
"""


def hiding(hidden, *words):
    code = HIDING.format(hidden=hidden, words=[str(word) for word in words])
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=300)


def has_osmesa():
    import ctypes.util

    return ctypes.util.find_library("OSMesa") is not None


@pytest.mark.slow
@pytest.mark.skipif(not has_osmesa(), reason="libosmesa6 is not installed")
def test_rendering_without_egl_uses_osmesa():
    done = hiding(["egl"], *ZERO, "--video", "x.gif", "--json", "viewer.width=160", "viewer.height=120")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["gl"] == "osmesa"
    assert Path("x.gif").stat().st_size > 10_000


def contents(folder):
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def test_rendering_without_gl_fails_and_leaves_run_unchanged(cli, only_run):
    words = ("scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")
    assert cli("train", "cartpole", *words, "--max-iterations", 1).code == 0
    before = contents(only_run())
    done = hiding(["egl", "osmesa"], "play", "cartpole", "--video", "--json")
    assert done.returncode == 10
    assert "no OpenGL backend works on this machine; tried egl" in done.stderr
    assert "osmesa" in done.stderr
    assert "apt install libegl1 libosmesa6" in done.stderr
    assert json.loads(done.stdout)["error"]["kind"] == "machine"
    assert "Traceback" not in done.stderr
    assert contents(only_run()) == before


def test_play_of_changed_observation_layout_prints_table(cli, only_run):
    words = ("scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")
    assert cli("train", "cartpole", *words, "--max-iterations", 1).code == 0
    file = only_run() / "config.yaml"
    file.write_text(file.read_text().replace("joint_vel_rel:\n", "velocity:\n", 1))
    done = cli("play", "--checkpoint", only_run())
    assert done.code == 5
    lines = [line for line in done.err.splitlines() if line.startswith("error:")]
    assert lines[0].endswith("does not fit the installed task:")
    assert lines[1].split() == ["error:", "field", "in", "the", "checkpoint", "now"]
    assert lines[2].index("joint_vel_rel (2") == lines[1].index("in the checkpoint")
    assert lines[2].index("velocity (2") == lines[1].rindex("now")
