"""`rlcli import oige`: the imported task equals the original."""

import json

import pytest
import torch
from reacher import TASK, TRAIN, YAML, arm_folder

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli_oige.importer import changed_imports

torch.set_num_threads(1)


def imported(folder, output, *words):
    return main(["import", "oige", str(folder / "Arm.yaml"), *words, "-o", str(output)])


def test_imported_task_equals_original_step_by_step(tmp_path):
    source = arm_folder(tmp_path / "arm")
    assert imported(source, tmp_path / "mine") == 0
    assert sorted(p.name for p in (tmp_path / "mine").iterdir()) == ["arm.py", "arm.xml", "shared.py", "task.yaml"]
    was, now = (resolve(find_task(str(place))) for place in (source, tmp_path / "mine"))
    assert now.task.model_dump(exclude={"agents"}) == was.task.model_dump(exclude={"agents"})
    assert now.agent == was.agent
    assert now.notes == ()
    rollouts = []
    for resolved in (was, now):
        torch.manual_seed(0)
        env = make_env(resolved, seed=1)
        env.reset()
        rollouts.append(torch.stack([env.step(torch.ones(4, 1)).obs["policy"].clone() for _ in range(20)]))
    assert torch.equal(*rollouts)


@pytest.mark.parametrize("name", ["../../evil", "..", "{tmp}/evil", "a\\nb", "x" * 300])
def test_task_name_that_is_path_is_refused(tmp_path, monkeypatch, capsys, name):
    (tmp_path / "a" / "b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a" / "b")
    file = tmp_path / "given.yaml"
    file.write_text(f'name: "{name}"\nenv: {{numEnvs: 4}}\nsim: {{dt: 0.01}}\n'.replace("{tmp}", str(tmp_path)))
    assert main(["import", "oige", str(file)]) == 3
    assert "is not a valid name of a Python class" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "a", tmp_path / "a" / "b", file]


def test_model_outside_task_folder_is_not_copied(tmp_path, capsys):
    source = arm_folder(tmp_path / "deep" / "arm")
    text = (source / "Arm.yaml").read_text()
    assert "arm.xml" in text
    (source / "Arm.yaml").write_text(text.replace("arm.xml", "../arm.xml"))
    (source / "arm.xml").rename(source.parent / "arm.xml")
    assert imported(source, tmp_path / "mine") in (3, 4)
    assert "outside" in capsys.readouterr().err
    assert not (tmp_path / "arm.xml").exists()


def test_import_from_package_copies_used_files(tmp_path):
    source = arm_folder(tmp_path / "arms")
    for file, place in (("arm.py", "tasks"), ("shared.py", "views"), ("Arm.yaml", "cfg/task"), ("arm.xml", "cfg/task")):
        (source / place).mkdir(parents=True, exist_ok=True)
        (source / file).rename(source / place / file)
    (source / "ArmPPO.yaml").unlink()
    shared = (source / "views" / "shared.py").read_text()
    (source / "tasks" / "warp").mkdir()
    for name, text in (("arm.py", TASK), ("shared.py", shared), ("other.py", "class OtherTask:\n    pass\n")):
        (source / "tasks" / "warp" / name).write_text(text)
    assert main(["import", "oige", str(source / "cfg" / "task" / "Arm.yaml"), "-o", str(tmp_path / "mine")]) == 0
    files = {str(file.relative_to(tmp_path / "mine")) for file in (tmp_path / "mine").rglob("*.*")}
    assert files == {"task.yaml", "arm.xml", "tasks/arm.py", "views/shared.py"}
    env = make_env(resolve(find_task(str(tmp_path / "mine"))), seed=1)
    env.reset()
    assert env.step(torch.ones(4, 1)).obs["policy"].isfinite().all()


def test_every_key_is_reported(tmp_path, capsys):
    source = arm_folder(tmp_path / "arm")
    assert imported(source, tmp_path / "mine", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    keys = {row["key"]: row["status"] for row in document["keys"]}
    assert keys["env.numEnvs"] == "mapped"
    assert keys["env.maxEffort"] == "task"
    assert keys["sim.physx.solver_type"] == "ignored"
    assert keys["params.network.separate"] == "approximated"
    lines = [(row["where"].rsplit(":", 2)[0], int(row["where"].rsplit(":", 2)[1])) for row in document["keys"]]
    assert lines == sorted(lines)


def test_import_without_class_validates_and_names_missing_file(tmp_path, capsys):
    source = arm_folder(tmp_path / "arm")
    for file in source.glob("*.py"):
        file.unlink()
    assert imported(source, tmp_path / "mine") == 0
    assert "put the Python file of ArmTask into" in capsys.readouterr().err
    assert main(["validate", str(tmp_path / "mine")]) == 0
    assert main(["validate", "--deep", str(tmp_path / "mine")]) == 4


def test_existing_task_is_not_overwritten(tmp_path, capsys):
    source = arm_folder(tmp_path / "arm")
    assert imported(source, tmp_path / "mine") == 0
    before = (tmp_path / "mine" / "task.yaml").read_bytes()
    assert imported(source, tmp_path / "mine") == 2
    assert "exists" in capsys.readouterr().err
    assert (tmp_path / "mine" / "task.yaml").read_bytes() == before


def test_other_formats_are_refused(tmp_path, capsys):
    (tmp_path / "task.yaml").write_text("decimation: 2\nscene: {}\n")
    assert main(["import", "oige", str(tmp_path / "task.yaml"), "-o", str(tmp_path / "out")]) == 3
    assert "is not a task of OmniIsaacGymEnvs" in capsys.readouterr().err
    assert main(["import", "oigge", str(tmp_path / "task.yaml")]) == 2
    assert "Did you mean 'oige'?" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_only_import_lines_change():
    text = (
        "import torch\nfrom omni.isaac.core.utils.torch.rotations import *\n"
        "from omniisaacgymenvs.tasks.base.rl_task import RLTask\nimport carb\n\nx = 'import omni'\n"
        "def f():\n    from pxr import Gf\n"
    )
    assert changed_imports(text) == (
        "import torch\nfrom rlcli_oige import *\nfrom rlcli_oige import RLTask\nfrom rlcli_oige import carb\n\n"
        "x = 'import omni'\ndef f():\n    from rlcli_oige import Gf\n"
    )


@pytest.mark.slow
def test_imported_task_trains_plays_and_resumes(tmp_path):
    yaml = YAML.replace("resolve_default:4", "resolve_default:16").replace(
        "maxEpisodeLength: 12", "maxEpisodeLength: 40"
    )
    source = arm_folder(tmp_path / "arm", yaml=yaml, task=TASK, train=TRAIN)
    assert imported(source, tmp_path / "mine") == 0
    runs = ["--runs-dir", str(tmp_path / "runs"), "-q", "--device", "cpu"]
    assert main(["train", str(tmp_path / "mine"), *runs, "--logger", "none", "--max-iterations", "3"]) == 0
    assert main(["train", "--resume", "latest", *runs, "--max-iterations", "4"]) == 0
    words = [
        "eval",
        "--checkpoint",
        "latest",
        "--runs-dir",
        str(tmp_path / "runs"),
        "--episodes",
        "4",
        "--num-envs",
        "4",
    ]
    assert main(words) == 0
