"""`rlcli new`: the package is complete and valid; invalid names are refused."""

import ast
import json
import tomllib

import jsonschema
import pytest
import yaml

from rlcli.cli.app import main
from rlcli.errors import pip_install
from rlcli.scaffold import FLAVOURS, render


def files_of(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_new_package_is_complete_and_valid(in_process, here, flavour):
    code, out, err = in_process("new", "my-arm-2", "--flavour", flavour, "--json")
    assert code == 0, err
    document = json.loads(out)
    folder = here / "my-arm-2"
    assert [path.name for path in here.iterdir()] == ["my-arm-2"]
    assert set(document["files"]) == files_of(folder)
    assert pip_install("-e .") + " && rlcli train my-arm-2" in err
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    assert project["name"] == "my-arm-2"
    assert project["entry-points"]["rlcli.tasks"] == {"my-arm-2": "my_arm_2:TASK"}
    for file in folder.rglob("*.py"):
        ast.parse(file.read_text())
    text = (folder / "my_arm_2" / "task.yaml").read_text()
    first = text.splitlines()[0]
    schema = folder / "my_arm_2" / first.removeprefix("# yaml-language-server: $schema=")
    jsonschema.validate(yaml.safe_load(text.replace("1e-3", "0.001")), json.loads(schema.read_text()))
    code, _, err = in_process("validate", "--deep", str(folder / "my_arm_2"))
    assert code == 0, err


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_template_marks_five_to_ten_lines_to_edit(flavour):
    files = render("my-arm", flavour)
    marked = [
        line for path, text in files.items() if path != "README.md" for line in text.splitlines() if "yours" in line
    ]
    assert 5 <= len(marked) <= 10


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_files_are_formatted_without_template_marks(flavour):
    for path, text in render("gitignore-arm", flavour).items():
        assert "{{" not in text, path
        assert "my-arm" not in text, path
        assert text.endswith("\n"), path
        assert max(map(len, text.splitlines())) <= 120, path
    assert "gitignore_arm/task.yaml" in render("gitignore-arm", flavour)


def test_schema_has_own_terms_and_finds_mistakes(in_process, here):
    assert in_process("new", "my-arm")[0] == 0
    schema = json.loads((here / "my-arm" / "task.schema.json").read_text())
    task = yaml.safe_load((here / "my-arm" / "my_arm" / "task.yaml").read_text().replace("1e-3", "0.001"))
    task["rewards"]["upright"]["func"] = "uprightnes"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(task, schema)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("MyArm", "did you mean 'my-arm'?"),
        ("my_arm", "did you mean 'my-arm'?"),
        ("my--arm", "did you mean 'my-arm'?"),
        ("9-lives", "did you mean 'lives'?"),
        ("größe", "only letters a-z"),
        ("arm\n", "only letters a-z"),
        ("../arm", "did you mean 'arm'?"),
        ("", "there is an empty word after new"),
        ("a" * 65, "at most 64"),
        ("class", "a keyword of Python"),
        ("random", "Python's standard library"),
        ("tests", "a usual name of test folders"),
        ("con", "the name of a device on Windows"),
        ("cartpole", "rlcli 0.1.0 already has a task 'cartpole'"),
        ("rlcli", "rlcli"),
        ("stable-baselines3", "is already installed"),
        ("torch", "torch"),
        ("rlcli-tasks", "a Python module 'rlcli_tasks' already exists"),
    ],
)
def test_invalid_name_writes_nothing(in_process, here, name, message):
    code, _, err = in_process("new", name)
    assert code == 2
    assert message in err
    assert not list(here.iterdir())


def test_unknown_flavour_is_usage_error(in_process, here):
    code, _, err = in_process("new", "my-arm", "--flavour", "yml")
    assert (code, "did you mean 'yaml'?" in err) == (2, True)
    assert not list(here.iterdir())


def test_non_empty_folder_is_not_changed(in_process, here):
    (here / "my-arm").mkdir()
    (here / "my-arm" / "notes.txt").write_text("mine")
    code, _, err = in_process("new", "my-arm")
    assert (code, "is not empty (notes.txt)" in err) == (2, True)
    (here / "file").write_text("mine")
    code, _, err = in_process("new", "my-arm", "-o", "file")
    assert (code, "is not a folder" in err) == (2, True)
    assert files_of(here) == {"my-arm/notes.txt", "file"}


def test_empty_and_nested_folders_are_filled(in_process, here):
    (here / "empty").mkdir()
    before = (here / "empty").stat().st_ino
    assert in_process("new", "my-arm", "-o", "empty")[0] == 0
    assert (here / "empty").stat().st_ino == before  # it may be the current folder of a shell
    assert in_process("new", "my-arm", "-o", "deep/er/arm")[0] == 0
    assert files_of(here / "empty") == files_of(here / "deep" / "er" / "arm")
    assert {path.name for path in here.iterdir()} == {"empty", "deep"}
    assert [path.name for path in (here / "deep" / "er").iterdir()] == ["arm"]


def test_current_folder_as_output(in_process, here):
    assert in_process("new", "my-arm", "-o", ".")[0] == 0
    assert (here / "my_arm" / "task.yaml").is_file()
    assert not [path for path in here.parent.iterdir() if path.name.startswith(".")]


def test_failed_write_leaves_nothing(monkeypatch, here, capfd):
    """The disk is full when the last file is written."""
    import rlcli.config.dump

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.chdir(here)
    monkeypatch.setattr(rlcli.config.dump, "json_schema", full)
    assert main(["new", "my-arm"]) == 10
    assert "No space left on device" in capfd.readouterr().err
    assert not list(here.iterdir())
