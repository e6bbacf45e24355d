"""Lookup of tasks and trainers in installed distributions, with broken ones among them."""

import os

import pytest

from rlcli.errors import TaskError
from rlcli.registry import TRAINERS, catalog, find_entry, find_task, folder_task, task_of_file

YAML = "summary: from a plugin\n"
HERE = {"task.yaml": YAML}


def names():
    return [entry.name for entry in catalog()[0]]


def failure(name):
    with pytest.raises(TaskError) as caught:
        find_task(name)
    return f"{caught.value.message} | {caught.value.hint}"


def test_find_task_by_name_and_distribution(plugins, spec):
    folder = plugins("robots", spec, task="walk", files=HERE)
    for name in ("walk", "robots:walk"):
        source = find_task(name)
        assert (source.name, source.distribution, source.version) == ("walk", "robots", "1.0")
        assert source.config == folder / "task.yaml"


def test_unknown_task_suggests_name_and_lists_tasks(plugins, spec):
    plugins("robots", spec, task="walk", files=HERE)
    said = failure("cartpol")
    assert "no task 'cartpol'" in said
    assert "did you mean 'cartpole'" in said
    assert "installed: ant, ant-direct, ball" in said
    assert "robots 1.0" in said
    assert "did you mean 'robots:walk'" in failure("robots:wlk")
    assert "overrides come after the task" in failure("sim.dt=1")


def test_ambiguous_name_lists_owners(plugins, spec):
    plugins("robots", spec, task="walk", files=HERE)
    plugins("animals", spec, task="walk", version="2.0", files=HERE)
    said = failure("walk")
    assert "in several packages: animals 2.0 and robots 1.0" in said
    assert "animals:walk or robots:walk" in said
    assert find_task("animals:walk").version == "2.0"


def test_first_copy_of_distribution_wins(plugins, spec):
    plugins("my-robots", spec, task="walk", files=HERE)
    plugins("my_robots", spec, task="walk", version="2.0", files=HERE)
    assert names().count("walk") == 1


@pytest.mark.parametrize(
    "broken",
    [
        {"entry_points": "[rlcli.tasks]\nthis is not an entry point\n"},
        {"metadata": ""},
        {"metadata": "Metadata-Version: 2.1\nName: bad\n"},
    ],
)
def test_bad_metadata_does_not_hide_other_plugins(plugins, spec, broken):
    plugins("bad", spec, **broken)
    plugins("good", spec, files=HERE)
    entries, unreadable = catalog()
    assert {"cartpole", "good-task"} <= {entry.name for entry in entries}
    assert [row.distribution for row in unreadable] == ["bad-1.0.dist-info"]
    assert "malformed metadata" in unreadable[0].reason


def test_unrelated_distribution_without_metadata_is_ignored(plugins):
    plugins("leftover", metadata="", entry_points="[console_scripts]\nx = y:z\n")
    assert catalog()[1] == []


IMPORT = "from rlcli.task import TaskSpec\n"
BROKEN = {
    "syntax": ("def f(:\n", "SyntaxError"),
    "missing": ("import no_such_module_anywhere\n", "ModuleNotFoundError: No module named 'no_such_module_anywhere'"),
    "exits": ("import sys\nsys.exit(3)\n", "SystemExit: 3"),
    "raises": ("\n\nraise ValueError('out of cheese')\n", "ValueError: out of cheese"),
    "empty": ("", "AttributeError"),
    "wrong": ("SPEC = {'package': 'x'}\n", "is a dict, expected a TaskSpec"),
    "newer": (IMPORT + "SPEC = TaskSpec(__name__, 'x', api=99)\n", "needs plugin API 99; this rlcli has 1"),
    "future": (IMPORT + "SPEC = TaskSpec(__name__, 'x', wings=2)\n", "TypeError"),
    "terms": (IMPORT + "SPEC = TaskSpec(__name__, 'x', terms='a.b')\n", "terms of a TaskSpec must be a tuple"),
    "nofile": (IMPORT + "SPEC = TaskSpec(__name__, 'x')\n", "task.yaml does not exist"),
    "nopackage": (IMPORT + "SPEC = TaskSpec('no.such', 'x')\n", "No module named 'no'"),
    "module": (IMPORT + "SPEC = TaskSpec('json.decoder', 'x')\n", "is not a package"),
    "noterms": (
        IMPORT + "SPEC = TaskSpec(__name__, 'x', config='__init__.py', terms=('noterms.t',))\n",
        "there is no module 'noterms.t'",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_plugin_error_names_plugin_and_reason(plugins, name):
    source, said = BROKEN[name]
    plugins(name, source, task="odd")
    message = failure("odd")
    assert said in message
    assert name in message
    assert find_task("cartpole").distribution == "rlcli"
    assert {"cartpole", "odd"} <= set(names())


def test_error_of_plugin_has_file_and_line(plugins):
    folder = plugins("raises", BROKEN["raises"][0])
    assert f"({folder / '__init__.py'}:3)" in failure("raises-task")


def test_entry_point_without_object_is_broken(plugins):
    plugins("half", entry_points="[rlcli.tasks]\nhalf = half\n")
    assert "plugin half 1.0: entry point 'half' = half cannot be imported" in failure("half")


@pytest.mark.parametrize(
    ("value", "there", "gone"),
    [
        ("none", ["cartpole"], ["a-task", "b-b-task"]),
        ("a", ["cartpole", "a-task"], ["b-b-task"]),
        ("a, B_B", ["cartpole", "a-task", "b-b-task"], []),
        ("", ["cartpole", "a-task", "b-b-task"], []),
    ],
)
def test_rlcli_plugins_selects_distributions(plugins, spec, monkeypatch, value, there, gone):
    plugins("a", spec)
    plugins("b-b", spec)
    monkeypatch.setenv("RLCLI_PLUGINS", value)
    found = names()
    assert set(there) <= set(found)
    assert not set(gone) & set(found)
    assert find_entry(TRAINERS, "sb3", what="trainer").distribution == "rlcli"


def test_folder_is_task(tmp_path, monkeypatch):
    folder = tmp_path / "hop"
    folder.mkdir()
    (folder / "task.yaml").write_text("{}")
    monkeypatch.chdir(tmp_path)
    for name in ("hop", "./hop", "hop/", str(folder)):
        source = find_task(name)
        assert (source.name, source.distribution, source.task, source.term_files) == ("hop", None, None, ())
    (folder / "terms.py").write_text("raise SystemExit\n")
    (folder / "task.py").write_text("raise SystemExit\n")
    source = find_task("./hop")
    assert source.term_files == (folder / "terms.py",)
    assert source.task == f"{folder / 'task.py'}:Task"


def test_installed_task_wins_over_folder(tmp_path, monkeypatch):
    (tmp_path / "cartpole").mkdir()
    (tmp_path / "cartpole" / "task.yaml").write_text("{}")
    monkeypatch.chdir(tmp_path)
    assert find_task("cartpole").distribution == "rlcli"
    assert find_task("./cartpole").distribution is None


def test_folder_without_task_lists_its_files(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    assert "it has no task.yaml; found: notes.txt" in failure(str(tmp_path))
    (tmp_path / "my-yam" / "my_yam").mkdir(parents=True)
    (tmp_path / "my-yam" / "my_yam" / "task.yaml").touch()
    with pytest.raises(TaskError) as package:
        find_task(str(tmp_path / "my-yam"))
    assert package.value.hint == f"did you mean '{tmp_path / 'my-yam' / 'my_yam'}'?"
    assert "no such folder" in failure(str(tmp_path / "nowhere"))
    assert "is a file, not a task's folder" in failure(str(tmp_path / "notes.txt"))


@pytest.mark.parametrize("kind", ["pipe", "folder", "broken link", "device"])
def test_special_file_is_not_a_task(tmp_path, kind):
    file = tmp_path / "task.yaml"
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    else:
        file.symlink_to("/dev/zero" if kind == "device" else tmp_path / "nothing")
    assert "task.yaml' is not a regular file" in failure(str(tmp_path))
    assert "'/dev/zero' is a device or pipe, not a task's folder" in failure("/dev/zero")


def test_folder_files_do_not_shadow_modules(tmp_path):
    """terms.py and task.py are common names: each folder imports its own files, and other modules do not find them."""
    import sys

    from rlcli.registry import load_module, load_object

    for number in (1, 2):
        folder = tmp_path / f"t{number}"
        folder.mkdir()
        (folder / "task.yaml").write_text("{}")
        (folder / "task.py").write_text(f"class Task:\n    number = {number}\n")
        (folder / "terms.py").write_text(f"number = {number}\n")
    one, two = (folder_task(tmp_path / f"t{n}") for n in (1, 2))
    assert (load_object(one.task).number, load_object(two.task).number) == (1, 2)
    assert load_module(one.term_modules[0]).number == 1
    assert load_module(two.term_modules[0]).number == 2
    assert load_module(two.term_modules[0]) is load_module(two.term_modules[0])
    assert "terms" not in sys.modules
    assert "task" not in sys.modules


def test_task_of_file_imports_only_its_plugin(plugins, spec):
    import sys

    folder = plugins("robots", spec, files=HERE)
    plugins("loud", "raise SystemExit('imported')\n")
    assert task_of_file(folder / "task.yaml").distribution == "robots"
    assert task_of_file(folder / "other.yaml") is None
    assert "loud" not in sys.modules


def test_folder_task_module_name_is_deterministic(tmp_path):
    """The module name must not depend on the hash seed, because pickled classes are sent between processes."""
    import os
    import subprocess
    import sys

    (tmp_path / "task.yaml").write_text("{}")
    (tmp_path / "terms.py").write_text("")
    program = f"from rlcli.registry import load_module; print(load_module({str(tmp_path / 'terms.py')!r}).__name__)"
    said = {
        subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2")
    }
    assert len(said) == 1


TRAINER = """
from rlcli.trainers import TrainerSpec
from rlcli.config.schema import AgentConfig
class Config(AgentConfig):
    speed: int = 3
MODELS = {"good": "mine:Config", "gone": "mine:Gone", "odd": "mine.odd:Config", "int": "builtins:int"}
SPEC = TrainerSpec("mine", MODELS, "")
"""


def with_algorithm(algorithm):
    from rlcli.config.load import resolve

    return resolve(find_task("cartpole"), overrides=[f"agent={{trainer: mine, algorithm: {algorithm}, max_steps: 1}}"])


def test_trainer_plugin_has_own_settings(plugins):
    plugins("mine", TRAINER, entry_points="[rlcli.trainers]\nmine = mine:SPEC\n")
    resolved = with_algorithm("good")
    assert resolved.agent.speed == 3
    assert resolved.trainer.summary == "mine"


@pytest.mark.parametrize(
    ("algorithm", "said"), [("gone", "AttributeError"), ("odd", "No module"), ("int", "AgentConfig")]
)
def test_broken_trainer_plugin_is_reported(plugins, algorithm, said):
    plugins("mine", TRAINER, entry_points="[rlcli.trainers]\nmine = mine:SPEC\n")
    with pytest.raises(TaskError, match=f"plugin mine 1.0.*: .*{said}"):
        with_algorithm(algorithm)
