"""User settings: their effects, their precedence, and the messages of a broken file."""

import json
import sys
import typing

import pytest
from support.pseudo_terminal import run_on_terminal

from rlcli.cli.ui import open_viewer
from rlcli.config.user_settings import read_settings
from rlcli.config.user_settings_schema import UserSettings
from rlcli.runs.run_ref import default_runs_dir
from rlcli.settings import settings_file, use_settings
from rlcli.training.loggers import LOGGERS


@pytest.fixture
def settings(tmp_path, monkeypatch):
    """Return a function that writes the settings file and returns its path."""
    file = tmp_path / "my settings.yaml"
    monkeypatch.setenv("RLCLI_SETTINGS", str(file))

    def write(text):
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return file

    return write


def test_precedence_of_flag_variable_settings_and_default(settings, in_process, monkeypatch, tmp_path):
    settings(f"runs_dir: '{tmp_path}/of-settings'\n")

    def error_output(*flags):
        return in_process("runs", *flags)[2]

    monkeypatch.delenv("RLCLI_RUNS_DIR", raising=False)
    assert f"no run in {tmp_path}/of-settings" in error_output()
    monkeypatch.setenv("RLCLI_RUNS_DIR", "of-variable")
    assert "no run in of-variable" in error_output()
    assert "no run in of-flag" in error_output("--runs-dir", "of-flag")
    monkeypatch.delenv("RLCLI_RUNS_DIR")
    monkeypatch.setenv("RLCLI_SETTINGS", "none")
    assert "no run in runs" in error_output()


def test_home_folder_is_expanded_and_library_ignores_settings(settings, in_process, monkeypatch, tmp_path):
    settings("runs_dir: ~/experiments\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("RLCLI_RUNS_DIR", raising=False)
    assert f"no run in {tmp_path}/experiments" in in_process("runs")[2]
    assert str(default_runs_dir()) == "runs"


def test_unknown_home_folder_stays_and_null_character_is_refused(settings, in_process, monkeypatch):
    monkeypatch.delenv("RLCLI_RUNS_DIR", raising=False)
    settings("runs_dir: ~nosuch/x\n")
    assert "no run in ~nosuch/x" in in_process("runs")[2]
    settings('runs_dir: "a\\0b"\n')
    code, _, err = in_process("runs")
    assert code == 3, err
    assert "runs_dir: the text has a null character; remove it" in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("verbosity", "flags", "loud"),
    [
        ("verbose", (), True),
        ("verbose", ("-q",), False),
        ("quiet", (), False),
        ("quiet", ("-v",), True),
        ("normal", (), False),
        ("normal", ("-v",), True),
        ("normal", ("-v", "-q"), False),
        ("normal", ("--quiet", "--verbose"), True),
    ],
)
def test_verbosity_flag_overrides_settings(settings, in_process, monkeypatch, verbosity, flags, loud):
    settings(f"verbosity: {verbosity}\n")
    monkeypatch.setattr("rlcli.cli.commands.validate.log_notes", lambda _: open_viewer.console.detail("a detail"))
    code, _, err = in_process("validate", "cartpole", *flags)
    assert code == 0
    assert ("a detail" in err) == loud


def test_preferred_viewer_applies_only_without_explicit_choice(monkeypatch):
    monkeypatch.setattr("rlcli.sim.gl.has_display", lambda: False)

    def first(viewer, port=None, headless=False):
        return open_viewer.choose_viewers(viewer, port, headless=headless)[0][0]

    with use_settings({"viewer": "web"}):
        assert first(None) == "web"
        assert first("auto") == "none", "not started from a terminal"
        assert first("none") == "none"
        assert first(None, headless=True) == "none", "a file is written"
    with use_settings({"viewer": "native"}):
        assert first(None) == "none", "there is no display"
    monkeypatch.setitem(open_viewer.VIEWERS, "another", "another.module:run")
    with use_settings({"viewer": "another"}):
        assert first(None) == "another"
    with use_settings({"viewer": "none"}):
        assert first(None, port=8080) == "web", "a port is a viewer in the browser"


def test_plugins_setting_hides_other_plugins(settings, in_process, monkeypatch):
    monkeypatch.delenv("RLCLI_PLUGINS", raising=False)
    file = settings("plugins: [no-such-plugin]\n")
    code, out, err = in_process("list-tasks", "--json")
    assert code == 0
    assert {task["distribution"] for task in json.loads(out)["tasks"]} == {"rlcli"}
    assert f"the key 'plugins' in {file} names 'no-such-plugin'" in err
    monkeypatch.setenv("RLCLI_PLUGINS", "another")
    assert "RLCLI_PLUGINS names 'another'" in in_process("list-tasks")[2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("verbosity: loud\n", ":1:1: verbosity: expected 'quiet', 'normal' or 'verbose', found 'loud'"),
        ("# mine\nveiwer: none\n", ":2:1: veiwer: unknown key 'veiwer'; did you mean 'viewer'?"),
        ("viewer: none\nagent: {}\n", ":2:1: agent: unknown key 'agent'"),
        ("loggers: [tensorboard, tensorbord]\n", ":1:24: loggers.1: expected"),
        ("loggers: []\n", ":1:1: loggers: expected at least 1 item"),
        ("runs_dir: 3\n", ":1:1: runs_dir: expected text, found 3"),
        ("runs_dir: [\n", ":2:1: "),
        ("- runs_dir\n", ":1:1: the top level must be a mapping"),
        (b"runs_dir: \xff\n", ":1:11: not UTF-8"),
        ("runs_dir: a\nruns_dir: b\n", ":2:1: duplicate key 'runs_dir'"),
        ("runs_dir: &a a\n", ":1:11: anchors and aliases are not allowed"),
        ("runs_dir: \x00\n", ":1:11: "),
    ],
)
def test_broken_settings_are_one_message_with_exit_code_3(settings, in_process, text, message):
    file = settings(text)
    for command in (["runs"], ["list-tasks"], ["train", "cartpole"], ["show", "cartpole"]):
        code, out, err = in_process(*command)
        assert (code, out) == (3, "")
        assert err.startswith(f"error: {file}{message}")
        assert len(err.splitlines()) == 1
    assert json.loads(in_process("runs", "--json")[1])["error"]["exit_code"] == 3


@pytest.mark.parametrize("command", [["--help"], ["train", "--help"], ["--version"], ["sweep", "-h"]])
def test_help_works_with_broken_settings(settings, in_process, command):
    settings("[")
    code, out, err = in_process(*command)
    assert (code, err) == (0, "")
    assert "rlcli" in out


def test_missing_settings_file_names_variable(monkeypatch, in_process, tmp_path):
    for named in (tmp_path / "gone.yaml", tmp_path):
        monkeypatch.setenv("RLCLI_SETTINGS", str(named))
        code, _, err = in_process("runs")
        assert code == 3
        assert err.startswith(f"error: {named}: the file cannot be read")
        assert "RLCLI_SETTINGS=none" in err


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the folder of other platforms is not moved by XDG")
def test_settings_file_is_in_platform_folder_and_optional(monkeypatch, tmp_path):
    monkeypatch.delenv("RLCLI_SETTINGS")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert settings_file() == tmp_path / "rlcli" / "settings.yaml"
    assert read_settings() == {}
    settings_file().parent.mkdir()
    settings_file().write_text("# nothing yet\n")
    assert read_settings() == {}
    settings_file().write_text("color: never\n")
    assert read_settings() == {"color": "never"}


def test_settings_have_same_choices_as_flags():
    def choices(field):
        return set(typing.get_args(UserSettings.model_fields[field].annotation))

    assert choices("viewer") == set(open_viewer.CHOICES)
    for name in (*LOGGERS, "none"):
        UserSettings(loggers=[name])
    assert not {"tasks", "agent", "device", "seed"} & set(UserSettings.model_fields)


def terminal_output(arguments, folder, **variables):
    """Return the output of a command on a terminal."""
    code, output = run_on_terminal(arguments, folder, **variables)
    assert code == 0
    return output


def test_colors_on_terminal_follow_variables_and_settings(settings, tmp_path):
    settings("{}")
    command = ["list-tasks", "cartpole"]
    assert b"\x1b[" in terminal_output(command, tmp_path)
    assert b"\x1b[" not in terminal_output(command, tmp_path, NO_COLOR="1")
    assert b"\x1b[" not in terminal_output(command, tmp_path, TERM="dumb")
    assert b"\x1b[" in terminal_output(command, tmp_path, NO_COLOR="")
    settings("color: never\n")
    assert b"\x1b[" not in terminal_output(command, tmp_path)
    assert b"\x1b[" in terminal_output(command, tmp_path, FORCE_COLOR="1")


def test_colors_in_pipe_only_if_forced(settings, rlcli):
    settings("{}")
    assert "\x1b" not in rlcli("list-tasks", "cartpole").stdout
    assert "\x1b[" in rlcli("list-tasks", "cartpole", FORCE_COLOR="1").stdout
    assert "\x1b" not in rlcli("list-tasks", "cartpole", FORCE_COLOR="1", NO_COLOR="1").stdout
    assert "\x1b" not in rlcli("list-tasks", "cartpole", "--json", FORCE_COLOR="1").stdout
    settings("color: always\n")
    assert "\x1b[" in rlcli("list-tasks", "cartpole").stdout
