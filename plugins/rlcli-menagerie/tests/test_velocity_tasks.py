"""Tasks on stand-in models, on the real models if installed, and without any model."""

import json
import os
import subprocess
import sys

import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import MissingModelError
from rlcli.registry import find_task, model_file
from rlcli.testing import check_task

TASKS = {"go1-velocity": 12, "g1-velocity": 29}
REAL = {}
for _task in TASKS:
    _found = resolve(find_task(_task))
    try:
        REAL[_task] = model_file(_found.source.root, _found.task.scene.entities["robot"].model)
    except MissingModelError:
        continue


def make(task, num_envs=4, *overrides):
    env = make_env(resolve(find_task(task), overrides=[f"scene.num_envs={num_envs}", *overrides]), seed=1)
    env.reset()
    return env


def rlcli(*arguments, **environment):
    kept = {name: value for name, value in os.environ.items() if name != "RLCLI_MODELS"}
    command = [sys.executable, "-m", "rlcli", *arguments]
    return subprocess.run(command, env={**kept, **environment}, capture_output=True, text=True)


@pytest.mark.parametrize(("task", "joints"), TASKS.items())
def test_stand_in_has_task_spaces_and_runs(models, task, joints):
    env = make(task)
    assert env.layout.action_size == joints
    assert env.layout.size() == 12 + 3 * joints
    for _ in range(20):
        result = env.step(torch.randn(4, joints, generator=torch.Generator().manual_seed(0)) * 0.1)
        assert result.obs["policy"].isfinite().all()
    assert env.divergences == 0


def test_gains_and_limits_come_from_task_with_and_without_actuators(models, go1_mjcf):
    values = []
    for driven in (True, False):
        (models / "unitree_go1" / "go1.xml").write_text(go1_mjcf(driven))
        model = make("go1-velocity", 1).engine.model
        assert model.nu == 12
        order = model.actuator_trnid[:, 0].argsort()
        fields = (
            model.actuator_gainprm[order, 0],
            model.actuator_biasprm[order, 1:3],
            model.actuator_forcerange[order],
        )
        values.append([field.tolist() for field in fields] + [model.dof_armature[6:].tolist()])
    assert values[0] == values[1]
    gains, bias, limits, armature = values[0]
    assert gains == [25.0] * 12
    assert bias == [[-25.0, -0.5]] * 12
    assert limits == [[-23.7, 23.7], [-23.7, 23.7], [-35.55, 35.55]] * 4
    assert armature == [0.00403, 0.00403, 0.00906] * 4


def test_go1_trains_with_fewer_environments_on_cpu(models):
    found = {device: resolve(find_task("go1-velocity"), device=device) for device in ("cpu", "cuda")}
    assert {device: each.task.scene.num_envs for device, each in found.items()} == {"cpu": 512, "cuda": 4096}
    assert found["cpu"].task.rewards == found["cuda"].task.rewards


def test_go1_stands_on_feet(models):
    env = make("go1-velocity", 2, "events.push=null", "events.payload=null")
    for _ in range(60):
        assert not env.step(torch.zeros(2, 12)).terminated.any()
    weight = 9.81 * float(env.engine.model.body_mass.sum())
    assert env.sensors["feet"].force[..., 2].sum(dim=1).tolist() == pytest.approx([weight] * 2, rel=0.1)


def test_g1_lying_down_terminates(models):
    env = make("g1-velocity", 2, "events.push=null")
    qpos = env.engine.field("qpos")
    qpos[1, 2:7] = torch.tensor([0.3, 0.7071068, 0.0, 0.7071068, 0.0])
    env.sim.on_moved(env._select_all())
    env.sim.forward_moved()
    assert env.step(torch.zeros(2, 29)).terminated.tolist() == [False, True]


@pytest.mark.parametrize("task", TASKS)
def test_missing_model_error_says_what_to_install(task, tmp_path):
    done = rlcli("eval", task, "--policy", "zero", "--json", "--quiet", PYTHONPATH=_without_mjlab())
    assert done.returncode == 4, done.stderr
    error = json.loads(done.stdout)["error"]
    robot = task.partition("-")[0]
    assert "the model is not on this machine: RLCLI_MODELS is not set; no Python package 'mjlab'" in error["message"]
    assert error["hint"] == (
        f"set RLCLI_MODELS to a folder that holds unitree_{robot}/{robot}.xml, or install the distribution"
        " that has the package mjlab"
    )
    assert len(done.stderr.splitlines()) <= 2
    checks = json.loads(rlcli("doctor", "--json", PYTHONPATH=_without_mjlab()).stdout)["checks"]
    assert error["hint"] in [check["hint"] for check in checks if check["name"] == f"task {task}"]
    shown = rlcli("show", task, PYTHONPATH=_without_mjlab())
    assert shown.returncode == 0, shown.stderr
    assert "track_lin_vel" in shown.stdout


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_contract_on_stand_in(models, task):
    assert [finding for finding in check_task(task) if finding.severity == "error"] == []


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="no real model: set RLCLI_MODELS, or install mjlab")
@pytest.mark.parametrize("task", REAL)
def test_real_model_runs_in_task(task):
    env = make(task, 4)
    for _ in range(25):
        result = env.step(torch.zeros(4, TASKS[task]))
        assert result.obs["policy"].isfinite().all()
    assert env.divergences == 0
    assert float(env.engine.model.body_mass.sum()) == pytest.approx({"go1": 12.7, "g1": 33.3}[task[:-9]], rel=0.1)


def _without_mjlab():
    return os.pathsep.join(place for place in sys.path if place and not os.path.isdir(os.path.join(place, "mjlab")))
