"""The front end as a plugin: lazy imports, former module names, and the plugin's entry in a run's record."""

import json
import subprocess
import sys

import torch
from cartpole_files import FILES

from rlcli.cli.app import main
from rlcli.registry import load_object

torch.set_num_threads(1)


def test_import_and_help_load_nothing_heavy():
    program = "import sys, rlcli_isaaclab, rlcli_isaaclab.format; from rlcli.cli.app import main\n"
    program += "main(['import', 'isaaclab', '--help']); print('torch' in sys.modules, 'mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].split() == ["False", "False"]


def test_package_exports_every_name():
    import rlcli_isaaclab

    assert all(hasattr(rlcli_isaaclab, name) for name in dir(rlcli_isaaclab))
    assert {"configclass", "sim_utils", "mdp", "ManagerBasedRLEnvCfg"} <= set(dir(rlcli_isaaclab))


def test_former_module_names_train_and_run_records_plugin(package, tmp_path, capsys):
    old = {name: text.replace("rlcli_isaaclab", "rlcli.isaaclab") for name, text in FILES.items()}
    folder = package()
    for name, text in old.items():
        assert "rlcli_isaaclab" not in text
        (folder / name).write_text(text)
    words = ["train", str(folder), "--num-envs", "4", "--max-iterations", "1", "--logger", "none", "--device", "cpu"]
    assert main([*words, "-q", "--runs-dir", str(tmp_path / "runs")]) == 0, capsys.readouterr().err
    (file,) = (tmp_path / "runs").glob("*/*/run.json")
    record = json.loads(file.read_text())
    assert record["versions"]["rlcli-isaaclab"] == "0.1.0"
    assert len(record["sources"]["rlcli_isaaclab"]) == 64
    capsys.readouterr()
    assert main(["eval", "--checkpoint", str(file.parent), "--episodes", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 4


def test_former_reference_resolves_to_same_module():
    from rlcli_isaaclab import managers, mdp

    assert load_object("rlcli.isaaclab.mdp:joint_pos_rel") is mdp.joint_pos_rel
    assert load_object("rlcli.isaaclab.managers:SceneEntityCfg") is managers.SceneEntityCfg
    assert "rlcli.isaaclab.managers" not in sys.modules
    assert managers.__spec__.name == "rlcli_isaaclab.managers"
