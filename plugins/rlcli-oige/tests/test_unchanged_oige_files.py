"""Task files with their original import lines, and Hydra's defaults lists."""

import sys

import pytest
import torch
from reacher import SHARED, TASK, TRAIN, YAML, arm_folder

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.config.strict_yaml import load
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, DependencyError, TaskError, pip_install
from rlcli.registry import find_task
from rlcli_oige import agent_yaml
from rlcli_oige.task_keys import ROOT_SETTINGS

torch.set_num_threads(1)

IMPORTS = """
import torch
import carb
import numpy as np
import omni.isaac.core.utils.torch as torch_utils
from gym import spaces
from omni.isaac.core.articulations import ArticulationView
from omni.isaac.core.objects import DynamicCuboid, DynamicSphere
from omni.isaac.core.prims import RigidPrimView
from omni.isaac.core.robots.robot import Robot
from omni.isaac.core.utils.prims import get_prim_at_path
from omni.isaac.core.utils.stage import get_current_stage
from omni.isaac.core.utils.torch.rotations import *
from omni.isaac.core.materials import PreviewSurface
from omniisaacgymenvs.tasks.base.rl_task import RLTask
from omniisaacgymenvs.robots.shared import limit_of_the_angle
from pxr import Gf, PhysxSchema, UsdLux, UsdPhysics
"""
UNCHANGED = IMPORTS + TASK[TASK.index("class ArmTask") :]
SPACES = "        self.space = spaces.Box(-np.Inf, np.Inf, (4,))\n        RLTask.__init__"


def package(folder, task=UNCHANGED, yaml=YAML, **files):
    """Write the arm as a package `omniisaacgymenvs` with the folders of the original; files: name -> YAML text."""
    top = folder / "omniisaacgymenvs"
    for name in ("tasks", "robots", "cfg/task", "cfg/train"):
        (top / name).mkdir(parents=True, exist_ok=True)
    for name in (top, top / "tasks"):
        (name / "__init__.py").write_text("")
    arm_folder(top / "cfg" / "task")
    for name in ("arm.py", "shared.py", "ArmPPO.yaml"):
        (top / "cfg" / "task" / name).unlink()
    (top / "robots" / "shared.py").write_text(SHARED)
    (top / "cfg" / "train" / "ArmPPO.yaml").write_text(TRAIN)
    (top / "tasks" / "arm.py").write_text(task)
    for name, text in {"Arm": yaml, **files}.items():
        (top / "cfg" / "task" / f"{name}.yaml").write_text(text)
    return top / "cfg" / "task" / "Arm.yaml"


def build(config, *overrides):
    torch.manual_seed(0)
    env = make_env(resolve(find_task(str(config)), overrides=overrides), seed=3)
    env.reset()
    return env


def test_original_import_lines_step_like_changed_ones(tmp_path):
    before = set(sys.modules)
    action = torch.linspace(-1.0, 1.0, 4)[:, None]
    unchanged = build(package(tmp_path, UNCHANGED.replace("        RLTask.__init__", SPACES)))
    ours = [unchanged.step(action).obs["policy"].clone() for _ in range(15)]
    changed = build(arm_folder(tmp_path / "arm"))
    theirs = [changed.step(action).obs["policy"].clone() for _ in range(15)]
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    new = {name.partition(".")[0] for name in set(sys.modules) - before}
    assert not new & {"omni", "pxr", "carb", "gym", "omniisaacgymenvs"}


@pytest.mark.parametrize(("first", "name"), [("", "convert_to_trimesh"), ("from matplotlib import colors\n", "mark")])
def test_helper_file_with_a_library_of_another_framework_belongs_to_its_task(tmp_path, first, name):
    """Isaac Lab's plugin replaces imports of `trimesh` and `matplotlib`; neither makes the file one of Isaac Lab's."""
    config = package(
        tmp_path, UNCHANGED.replace("import carb", "import carb\nfrom omniisaacgymenvs.robots import marks")
    )
    helper = f"{first}from pxr import UsdPhysics\n\n\ndef {name}():\n    return UsdPhysics.CollisionAPI\n"
    (config.parents[2] / "robots" / "marks.py").write_text(helper)
    env = build(config)
    marks = sys.modules[type(env.task).__module__].marks
    assert getattr(marks, name)().__module__.startswith("rlcli_oige")


def test_folder_without_package_has_its_own_modules(tmp_path):
    env = build(arm_folder(tmp_path / "arm", task=UNCHANGED))
    assert env.step(torch.zeros(4, 1)).obs["policy"].isfinite().all()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("PhysxSchema.PhysxDeformableBodyAPI.Apply(arm.prim)", "deformable bodies"),
        ("hydra.compose(config_name='a')", "no counterpart of hydra.compose: rlcli composes the YAML files"),
        ("UsdPhysics.DriveAPI.Apply(get_prim_at_path(arm.prim_path + '/base/elbow'), 'angular')", "no joint 'elbow'"),
        ("omni.timeline.get_timeline_interface()", "no counterpart of omni.timeline"),
        ("carb.settings.get_settings()", "no counterpart of carb.settings"),
        ("Gf.Rotation()", "no counterpart of pxr.Gf.Rotation"),
        ("arm.get_joints_default_state()", "rlcli's Robot has no 'get_joints_default_state'"),
        ("self._sim_config.set_wind(3)", "rlcli's SimConfig has no 'set_wind'"),
        ("scene.enable_bounding_boxes_computations()", "rlcli's SceneRegistry has no"),
    ],
)
def test_missing_features_name_the_line(tmp_path, line, message):
    task = UNCHANGED.replace("        ball = Dyn", f"        {line}\n        ball = Dyn")
    number = task[: task.index(line)].count("\n") + 1
    with pytest.raises(TaskError) as caught:
        build(package(tmp_path, task.replace("import carb", "import carb, hydra, omni.timeline")))
    assert f"arm.py:{number}: " in str(caught.value)
    assert message in str(caught.value)


def test_calls_without_effect_are_logged_once(tmp_path, caplog):
    lines = """        for number in range(3):
            UsdLux.DomeLight.Define(get_current_stage(), "/World/light").CreateIntensityAttr().Set(1000)
            PreviewSurface(prim_path="/World/Looks/red")
            body = PhysxSchema.PhysxRigidBodyAPI.Apply(get_prim_at_path(arm.prim_path + "/left"))
            body.GetSleepThresholdAttr().Set(0.0)
            body.CreateLinearDampingAttr().Set(0.5)
            body.CreateAngularDampingAttr().Set(0.0)
            PhysxSchema.PhysxSDFMeshCollisionAPI.Apply(arm.prim)
"""
    with caplog.at_level("INFO"):
        build(package(tmp_path, UNCHANGED.replace("        ball = Dyn", f"{lines}        ball = Dyn")))
    (ignored,) = [record.message for record in caplog.records if record.message.startswith("ignored: ")]
    (lost,) = [record.message for record in caplog.records if record.message.startswith("not simulated: ")]
    assert [ignored.count(name) for name in ("UsdLux [", "PreviewSurface [", "SleepThreshold [")] == [1, 1, 1]
    assert [(name in lost) for name in ("LinearDamping", "AngularDamping", "SDFMesh")] == [True, False, True]


def test_missing_module_and_refused_task_name_file(tmp_path):
    with pytest.raises(DependencyError, match=r"arm.py:2: the task imports 'no_such_package_x'") as caught:
        build(package(tmp_path / "a", "\nimport no_such_package_x\n" + UNCHANGED))
    assert caught.value.hint == pip_install("no_such_package_x")
    config = package(tmp_path / "b")
    folder = config.parents[2] / "tasks"
    (folder / "warp").mkdir()
    (folder / "warp" / "arm.py").write_text(f"# a comment\n\nimport warp as wp\n{(folder / 'arm.py').read_text()}")
    (folder / "arm.py").unlink()
    with pytest.raises(TaskError, match=r"warp/arm.py:3: .*Warp arrays are not supported"):
        build(config)


def test_own_post_physics_step_and_steps_inside_an_action(tmp_path, caplog):
    extra = """
    def post_physics_step(self):
        self.progress_buf[:] += 1
        self.get_observations()
        self.calculate_metrics()
        self.is_done()
        ids = self.reset_buf.nonzero(as_tuple=False).flatten()
        if len(ids) > 0:
            self.reset_idx(ids)
        self.obs_buf[:, 3] = 7.0
        return self.obs_buf, self.rew_buf, self.reset_buf, self.extras
"""
    inside = "        for _ in range(3):\n            SimulationContext.step(self.world, render=False)\n"
    line = "        forces[:, self._left]"
    task = UNCHANGED.replace(line, inside + line) + extra
    task = task.replace("import carb", "import carb\nfrom omni.isaac.core.simulation_context import SimulationContext")
    env = build(package(tmp_path, task))
    result = env.step(torch.zeros(4, 1))
    assert (result.obs["policy"][:, 3] == 5.0).all()  # 7, clipped to 5
    assert any("3 physics steps of its own: a step lasts 0.05 s" in record.message for record in caplog.records)
    steps = [env.step(torch.zeros(4, 1)) for _ in range(11)]
    assert torch.stack([step.truncated | step.terminated for step in steps]).any(dim=0).all()
    assert torch.stack([step.truncated for step in steps]).any()


BASE = YAML.replace("name: Arm", "name: Base")


@pytest.mark.parametrize(
    ("defaults", "effort", "envs"),
    [("[Base, _self_]", 5.0, 4), ("[_self_, Base]", 2.0, 4), ("[Base]", 5.0, 4), ("[Base, Half, _self_]", 5.0, 2)],
)
def test_defaults_are_merged_in_order(tmp_path, defaults, effort, envs):
    own = f"defaults: {defaults}\nname: Arm\nenv:\n  maxEffort: 5.0\n"
    config = package(tmp_path, yaml=own, Base=BASE, Half="env: {numEnvs: 2, maxEffort: 9.0}\n")
    found = resolve(find_task(str(config)))
    assert found.task.foreign["oige"]["env"]["maxEffort"] == effort
    assert found.task.scene.num_envs == envs
    assert found.task.sim.dt == 0.01


@pytest.mark.parametrize(
    ("own", "base", "place", "message"),
    [
        (
            "defaults: [Base, _self_]\n",
            BASE.replace("  dt: 0.01", "  dtt: 0.01"),
            "Base.yaml:13:3",
            "unknown key 'dtt'",
        ),
        ("defaults:\n  - Bse\n", BASE, "Arm.yaml:2:5", "no file for 'Bse'"),
        ("defaults: [/schema]\n", BASE, "Arm.yaml:1:12", "no configurations that Python code registers"),
        ("defaults: [Base]\n", "defaults: [Arm]\n" + BASE, "Base.yaml:1:12", "lists itself"),
        ("defaults: Base\n", BASE, "Arm.yaml:1:1", "expected a list"),
    ],
)
def test_wrong_defaults_name_file_and_line(tmp_path, own, base, place, message):
    config = package(tmp_path, yaml=f"{own}name: Arm\nenv: {{a: 1}}\nsim: {{}}\n", Base=base)
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(str(config)))
    problem = next(p for p in caught.value.problems if message in p.message)
    assert problem.where.endswith(place)


def test_models_beside_the_files(tmp_path, capsys):
    config = package(tmp_path, yaml=YAML.partition("mjcf:")[0])
    model = tmp_path / "elsewhere" / "arm.xml"
    model.parent.mkdir()
    (config.parent / "arm.xml").rename(model)
    (tmp_path / "models.yaml").write_text("Arm: elsewhere/arm.xml\n")
    assert main(["validate", str(config), "--deep"]) != 0
    error = capsys.readouterr().err
    assert "arm.py:" in error
    assert "'/World/envs/env_0/Arm' has no model" in error
    assert "--model Arm=FILE.xml" in error
    for word in (f"Arm={model}", str(tmp_path / "models.yaml")):
        assert main(["validate", str(config), "--deep", "--model", word]) == 0, capsys.readouterr().err
    assert main(["validate", str(config), "--model", "Arm=nothing.xml"]) == 2
    assert "there is no file 'nothing.xml'" in capsys.readouterr().err
    assert main(["validate", "cartpole", "--model", f"robot={model}"]) != 0
    assert "set scene.entities.robot.model" in capsys.readouterr().err


ROOT = {**ROOT_SETTINGS, "task": {"env": {"numEnvs": 4}}}
CNN = "    cnn: {type: conv2d, activation: relu, convs: [{filters: 8, kernel_size: 4, strides: 2, padding: 0}]}\n"


def test_convolutions_become_cnn():
    agent = agent_yaml.translate(load(TRAIN.replace("    mlp:", f"{CNN}    mlp:")), "t", ROOT)
    assert agent.data["cnn"] == {"channels": [8], "kernels": [4], "strides": [2]}
    assert any("activation of the MLP" in note.text for note in agent.notes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("padding: 0", "padding: 1", "no padding"),
        ("type: conv2d", "type: conv1d", "'conv1d' has no counterpart"),
        ("convs: [{filters: 8, kernel_size: 4, strides: 2, padding: 0}]", "convs: 3", "a list `convs` with its layers"),
    ],
)
def test_other_convolutions_are_refused(old, new, message):
    document = load(TRAIN.replace("    mlp:", f"{CNN.replace(old, new)}    mlp:"))
    with pytest.raises(ConfigError, match=message):
        agent_yaml.translate(document, "train.yaml", ROOT)
