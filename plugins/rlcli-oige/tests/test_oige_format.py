"""The front end as a plugin: lazy imports, former module names, and the plugin's entry in a run's record."""

import json
import subprocess
import sys

import pytest
from reacher import TASK, arm_folder

from rlcli.cli.app import main

OLD = TASK.replace("rlcli_oige", "rlcli.oige")


@pytest.mark.parametrize("command", ["validate", "show"])
def test_yaml_is_read_without_torch(tmp_path, command):
    folder = arm_folder(tmp_path / "arm")
    program = (
        f"import sys; from rlcli.cli.app import main; code = main([{command!r}, {str(folder)!r}]); "
        "print(code, *sorted({'torch', 'mujoco', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0", done.stderr


def test_import_loads_nothing_heavy():
    program = "import sys, rlcli_oige, rlcli_oige.format; print('torch' in sys.modules, 'pydantic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_former_module_name_trains_and_run_records_plugin(tmp_path, capsys):
    folder = arm_folder(tmp_path / "arm", task=OLD)
    words = ["train", str(folder), "--num-envs", "4", "--max-iterations", "1", "--logger", "none", "--device", "cpu"]
    words += ["-q", "--runs-dir", str(tmp_path / "runs"), "agent.minibatch_size=16"]
    assert main(words) == 0, capsys.readouterr().err
    (file,) = (tmp_path / "runs").glob("*/*/run.json")
    record = json.loads(file.read_text())
    assert record["versions"]["rlcli-oige"] == "0.1.0"
    assert len(record["sources"]["rlcli_oige"]) == 64
    assert "rlcli.oige" not in sys.modules or sys.modules["rlcli.oige"] is sys.modules["rlcli_oige"]
    capsys.readouterr()
    assert main(["eval", "--checkpoint", str(file.parent), "--episodes", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 4
