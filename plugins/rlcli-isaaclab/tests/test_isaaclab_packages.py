"""Packages built on Isaac Lab: folders on `sys.path`, libraries, actuators of their own, kinematic objects, ranges."""

import dataclasses
import sys
import threading

import pytest
import torch
from test_isaaclab_user_code import rover

from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, TaskError, pip_install
from rlcli.registry.module_names import OWN_NAMES
from rlcli_isaaclab import direct_convert, namespace
from rlcli_isaaclab.config_class import is_missing
from rlcli_isaaclab.convert import agent
from rlcli_isaaclab.format import LIBRARIES
from rlcli_isaaclab.settings import Report

torch.set_num_threads(1)


def stepped(resolved, steps=3, seed=0):
    env = make_env(resolved, seed=seed)
    env.reset()
    for _ in range(steps):
        result = env.step(torch.full((env.num_envs, env.layout.action_size), 0.5))
    return env, result


def test_package_in_a_folder_that_a_task_file_adds_to_sys_path(tmp_path):
    robots = tmp_path / "repository" / "robots_of_test"
    robots.mkdir(parents=True)
    (robots / "__init__.py").write_text("from .gains import STIFFNESS\n")
    (robots / "gains.py").write_text(
        "from isaaclab.utils.math import wrap_to_pi\n\nSTIFFNESS = float(wrap_to_pi(__import__('torch').zeros(1)))\n"
    )
    added = "import sys\nfrom pathlib import Path\nsys.path.insert(0, str(Path(__file__).resolve().parents[1]))\n"
    code = f"{added}from robots_of_test.gains import STIFFNESS\nassert STIFFNESS == 0.0\n"
    stepped(rover(tmp_path / "repository" / "tasks", code))


def test_package_of_another_distribution_in_the_repository(tmp_path):
    source = tmp_path / "source"
    robots = source / "arms_of_test" / "arms_of_test"
    robots.mkdir(parents=True)
    (robots / "__init__.py").write_text("from isaaclab.utils import configclass\n\nSTIFFNESS = 3.0\n")
    stepped(rover(source / "tasks_of_test", "from arms_of_test import STIFFNESS\n"))


def test_package_at_a_root_that_pythonpath_names(tmp_path, monkeypatch):
    robots = tmp_path / "root" / "shared_robots_of_test"
    robots.mkdir(parents=True)
    (robots / "__init__.py").write_text("")
    (robots / "gains.py").write_text("from isaaclab.utils import configclass\n\nSTIFFNESS = 3.0\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "root"))
    monkeypatch.syspath_prepend(str(tmp_path / "root"))
    stepped(rover(tmp_path / "root" / "tasks", "from shared_robots_of_test.gains import STIFFNESS\n"))


@pytest.mark.parametrize("library", sorted(LIBRARIES))
def test_missing_library_of_isaac_lab_is_named_when_it_is_used(tmp_path, monkeypatch, library):
    find = namespace.importlib.util.find_spec
    monkeypatch.setattr(namespace.importlib.util, "find_spec", lambda name: None if name == library else find(name))
    reward = f"from {library} import Thing\n\ndef alive(env):\n    return Thing(env)()\n"
    resolved = rover(tmp_path / "rover", reward, rewards={"own": "RewardTermCfg(func=alive, weight=1.0)"})
    monkeypatch.undo()
    with pytest.raises(TaskError) as raised:
        stepped(resolved)
    assert raised.value.hint == pip_install(LIBRARIES[library])
    assert "rover_env.py:" in raised.value.message


def table_fields(name, seen=()):
    """Return the settings that Isaac Lab's class has, with those of its bases."""
    kind = namespace._definitions()[name][1]
    fields = {}
    for base in reversed(kind["bases"]):
        base = base.rpartition(".")[2]
        parent = namespace._definitions().get(base)
        if parent and isinstance(parent[1], dict) and base not in seen:
            fields |= table_fields(base, (*seen, name))
    return fields | kind.get("fields", {})


def test_every_class_of_settings_has_the_settings_of_isaac_lab():
    missing = {}
    for name, (_, kind) in namespace._definitions().items():
        own = namespace.lab_name(name) if isinstance(kind, dict) and not name.startswith("DirectMARL") else None
        if dataclasses.is_dataclass(own):
            lacks = set(table_fields(name)) - {field.name for field in dataclasses.fields(own)}
            missing |= {name: lacks} if lacks else {}
    assert not missing


def test_markers_of_a_command_can_be_changed():
    cfg = namespace.lab_name("UniformVelocityCommandCfg")()
    cfg.goal_vel_visualizer_cfg.markers["arrow"].scale = (0.5, 0.5, 0.5)
    assert is_missing(cfg.asset_name)


MOVES_BOX = """
from isaaclab.assets import RigidObjectCfg

def move(env, env_ids, asset_cfg):
    pose = env.scene["box"].data.root_state_w[env_ids].clone()
    pose[:, 0] = 1.0 + env_ids.float()
    env.scene["box"].write_root_state_to_sim(pose, env_ids)

def add_box():
    spawn = sim_utils.CuboidCfg(
        size=(0.1, 0.1, 0.1), rigid_props=sim_utils.RigidBodyPropertiesCfg(kinematic_enabled=True)
    )
    return RigidObjectCfg(prim_path="{ENV_REGEX_NS}/Box", spawn=spawn)
"""


def test_user_event_moves_a_kinematic_object(tmp_path):
    event = "EventTermCfg(func=move, mode='reset', params={'asset_cfg': None})"
    scene = ("    robot = ArticulationCfg(", "    box = add_box()\n    robot = ArticulationCfg(")
    env = make_env(rover(tmp_path / "rover", MOVES_BOX, [scene], events={"move": event}), seed=0)
    env.reset()
    assert env.entities["box"].data.root_pos_w[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]


def test_range_from_high_to_low_is_the_same_range(tmp_path):
    params = "{{'pose_range': {{'x': {}}}, 'velocity_range': {{}}}}"
    event = "EventTermCfg(func=mdp.reset_root_state_uniform, mode='reset', params={})"
    low, high = (
        rover(tmp_path / name, events={"place": event.format(params.format(pair))})
        for name, pair in (("low", (-0.3, 0.2)), ("high", (0.2, -0.3)))
    )
    assert high.task.events["place"].params == low.task.events["place"].params


ACCELERATION = """
def speedup(asset, ids):
    return asset.data.body_lin_acc_w[:, ids].norm(dim=-1).sum(dim=1)

def calm(env, asset_cfg=SceneEntityCfg("robot", body_names=["upper"])):
    return speedup(env.scene["robot"], asset_cfg.body_ids)
"""


def test_function_that_a_term_calls_may_read_accelerations(tmp_path):
    calm = "RewardTermCfg(func=calm, weight=1.0)"
    _, result = stepped(rover(tmp_path / "rover", ACCELERATION, rewards={"calm": calm}))
    assert float(result.reward.min()) > 0.0


def test_episode_ends_when_its_command_is_due_again(tmp_path):
    ranges = "mdp.UniformVelocityCommandCfg.Ranges(lin_vel_x=(0, 1), lin_vel_y=(0, 1), ang_vel_z=(0, 1))"
    command = f"mdp.UniformVelocityCommandCfg(asset_name='robot', resampling_time_range=(0.1, 0.1), ranges={ranges})"
    due = "    due = TerminationTermCfg(func=mdp.command_resample, params={'command_name': 'base_velocity'})\n"
    terms = ("class Terminations:\n", f"class Terminations:\n{due}")
    env = make_env(rover(tmp_path / "rover", "", [terms], commands={"base_velocity": command}), seed=0)
    env.reset()
    ended = [bool(env.step(torch.zeros(4, 2)).terminated.all()) for _ in range(10)]
    assert ended == [False, False, False, False, True] * 2  # 0.1 s are five steps


ACTUATOR = """
from dataclasses import MISSING
from isaaclab.actuators import DCMotor, DCMotorCfg, DelayedPDActuator, DelayedPDActuatorCfg
from isaaclab.actuators import IdealPDActuator, IdealPDActuatorCfg
from isaaclab.utils.types import ArticulationActions

class Rubbing(BASE):
    def __init__(self, cfg, *args, **kwargs):
        super().__init__(cfg, *args, **kwargs)
        self._rub = self._parse_joint_parameter(cfg.rub, 0.0)
        assert self.joint_names == ["arm"] and self._num_envs == 4

    def compute(self, control_action, joint_pos, joint_vel):
        action = super().compute(control_action, joint_pos, joint_vel)
        self.applied_effort = self.applied_effort - self._rub * joint_vel
        action.joint_efforts = self.applied_effort
        return action

@configclass
class RubbingCfg(BASECfg):
    class_type: type = Rubbing
    rub: float = 0.0
"""


def with_actuator(folder, base, made):
    old = 'ImplicitActuatorCfg(joint_names_expr=["arm"], stiffness=20.0, damping=1.0)'
    return rover(folder, ACTUATOR.replace("BASE", base), [(old, made)])


SETTINGS = {
    "IdealPDActuator": "joint_names_expr=['arm'], stiffness=20.0, damping=1.0, effort_limit=2.0",
    "DCMotor": "joint_names_expr=['arm'], stiffness=200.0, damping=1.0, effort_limit=6.0, saturation_effort=8.0,"
    " velocity_limit=2.0",
    "DelayedPDActuator": "joint_names_expr=['arm'], stiffness=20.0, damping=1.0, effort_limit=9.0, min_delay=2,"
    " max_delay=2",
}


@pytest.mark.parametrize("base", SETTINGS)
def test_actuator_class_of_the_user(tmp_path, base):
    settings = SETTINGS[base]
    of_rlcli = with_actuator(tmp_path / "plain", base, f"{base}Cfg({settings})")
    own = with_actuator(tmp_path / "own", base, f"RubbingCfg({settings}, rub=0.0)")
    rubbing = with_actuator(tmp_path / "rubbing", base, f"RubbingCfg({settings}, rub={{'ar.*': 0.7}})")
    angles = [stepped(r, steps=12)[0].entities["robot"].data.joint_pos[:, 0] for r in (of_rlcli, own, rubbing)]
    assert torch.allclose(angles[1], angles[0], atol=1e-5)
    assert not torch.allclose(angles[2], angles[0], atol=1e-3)


def test_state_of_a_users_actuator_is_saved(tmp_path):
    resolved = with_actuator(tmp_path / "own", "DelayedPDActuator", f"RubbingCfg({SETTINGS['DelayedPDActuator']})")
    first, _ = stepped(resolved, steps=4)
    state = first.state_dict()
    second = make_env(resolved, seed=0)
    second.reset()
    second.load_state_dict(state)
    results = [env.step(torch.full((4, 2), -0.5)).obs["policy"] for env in (first, second)]
    assert torch.equal(*results)


LATE = """
from isaaclab.managers import ManagerTermBase
from isaaclab.utils.buffers import DelayBuffer

class Late(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.delay = DelayBuffer(3, env.num_envs, env.device)
        self.delay.set_time_lag(3)

    def __call__(self, env):
        return self.delay.compute(env.scene["robot"].data.joint_pos[:, 0])
"""


def test_buffer_of_a_users_term_is_saved(tmp_path):
    resolved = rover(tmp_path / "rover", LATE, rewards={"late": "RewardTermCfg(func=Late, weight=1.0)"})
    first, _ = stepped(resolved, steps=6)
    second = make_env(resolved, seed=0)
    second.reset()
    second.load_state_dict(first.state_dict())
    rewards = [env.step(torch.zeros(4, 2)).reward for env in (first, second)]
    assert torch.equal(*rewards)
    assert bool((rewards[0] != 0.0).all())


def test_missing_names_of_an_entity_are_named(tmp_path):
    functions = "from dataclasses import MISSING\n\ndef own(env, asset_cfg):\n    return torch.ones(env.num_envs)\n"
    term = "RewardTermCfg(func=own, weight=1.0, params={'asset_cfg': SceneEntityCfg('robot', body_names=MISSING)})"
    with pytest.raises(ConfigError, match="missing 'body_names'"):
        rover(tmp_path / "rover", functions, rewards={"own": term})


RAYS = """
from isaaclab.assets import AssetBaseCfg
from isaaclab.sensors import RayCasterCfg, patterns

def rays(env):
    sensor = env.scene.sensors["scanner"]
    assert sensor.ray_starts.shape == sensor.ray_directions.shape == (4, sensor.num_rays, 3)
    assert torch.equal(sensor.ray_directions[0, 0], torch.tensor([0.0, 0.0, -1.0]))
    return sensor.ray_starts[..., 2].mean(dim=1)

def wrong(env):
    return env.scene.sensors["scanner"].ray_strats
"""


SCANNER = """
    scanner = RayCasterCfg(
        prim_path="{ENV_REGEX_NS}/Robot/base", offset=RayCasterCfg.OffsetCfg(pos=(0.0, 0.0, 20.0)),
        pattern_cfg=patterns.GridPatternCfg(resolution=0.5, size=(1.0, 1.0)), mesh_prim_paths=["/World/ground"],
    )
    ground = AssetBaseCfg(prim_path="/World/ground", spawn=sim_utils.GroundPlaneCfg())
    robot = ArticulationCfg("""


def with_scanner(folder, reward):
    terms = {"rays": f"RewardTermCfg(func={reward}, weight=1.0)"}
    return rover(folder, RAYS, [("    robot = ArticulationCfg(", SCANNER)], rewards=terms)


def test_term_reads_the_pattern_of_a_ray_caster(tmp_path):
    _, result = stepped(with_scanner(tmp_path / "rover", "rays"))
    assert result.reward == pytest.approx(torch.full((4,), 20.0 * 0.02), abs=1e-3)


def test_unknown_attribute_of_a_sensor_has_file_and_line(tmp_path):
    resolved = with_scanner(tmp_path / "rover", "wrong")
    with pytest.raises(AttributeError, match=r"rover_env.py:\d+: a sensor of rlcli has no 'ray_strats'; did you mean"):
        stepped(resolved)


ACTION_OF_TERM = """
def arm(env):
    term = env.action_manager.get_term("arm")
    assert term._joint_names == ("arm",) and term.action_dim == 1
    return env.scene["robot"].data.joint_pos[:, term._joint_ids].sum(dim=1)

def wrong(env):
    return env.action_manager.get_term("arm").raw_action
"""


def test_term_reads_the_joints_of_an_action(tmp_path):
    reward = {"arm": "RewardTermCfg(func=arm, weight=1.0)"}
    env, result = stepped(rover(tmp_path / "rover", ACTION_OF_TERM, rewards=reward))
    assert result.reward == pytest.approx(env.entities["robot"].data.joint_pos[:, 0] * 0.02, abs=1e-4)


def test_unknown_attribute_of_an_action_has_file_and_line(tmp_path):
    resolved = rover(tmp_path / "rover", ACTION_OF_TERM, rewards={"arm": "RewardTermCfg(func=wrong, weight=1.0)"})
    with pytest.raises(AttributeError, match=r"rover_env.py:\d+: an action of rlcli has no 'raw_action'; did you mean"):
        stepped(resolved)


HOLES = """
from isaaclab.terrains.height_field.utils import height_field_to_mesh

@height_field_to_mesh
def holes(difficulty, cfg):
    raise NotImplementedError
"""


def test_terrain_function_of_the_user_is_imported(tmp_path):
    stepped(rover(tmp_path / "rover", HOLES))


def test_missing_module_of_isaac_lab_has_its_name_and_the_users_line(tmp_path, monkeypatch):
    package = tmp_path / "source" / "isaaclab_assets"
    (package / "robots").mkdir(parents=True)
    for folder in (package, package / "robots"):
        (folder / "__init__.py").write_text("")
    monkeypatch.setenv(namespace.SOURCE, str(tmp_path / "source"))
    namespace._source_folder.cache_clear()
    code = "from isaaclab_assets.robots.spider import SPIDER_CFG\n"
    with pytest.raises(TaskError, match=r"no module 'isaaclab_assets.robots.spider'.*rover_env.py:\d+\)"):
        rover(tmp_path / "rover", code)
    namespace._source_folder.cache_clear()


CONTACTS = '__import__("isaaclab.sensors", fromlist=["x"]).ContactSensorCfg(prim_path="{ENV_REGEX_NS}/Robot/.*")'


def test_missing_assets_are_the_only_message(tmp_path, monkeypatch):
    monkeypatch.delenv(namespace.SOURCE, raising=False)
    namespace._source_folder.cache_clear()
    step = "        self.decimation, self"
    changes = [(step, f'        self.scene.robot = SPOT_CFG.replace(prim_path="{{ENV_REGEX_NS}}/Robot")\n{step}')]
    changes.append(("    robot = Art", f"    contacts = {CONTACTS}\n    robot = Art"))
    with pytest.raises(ConfigError) as caught:
        rover(tmp_path / "rover", "from isaaclab_assets.robots.spot import SPOT_CFG\n", changes)
    (first,) = caught.value.problems  # not those of the sensor
    file = tmp_path / "rover" / "rover_env.py"
    assert first.message == f"no folder has isaaclab_assets, from which {file} imports SPOT_CFG"
    assert "RLCLI_ISAACLAB" in first.hint


RUNNER_5 = {
    "num_steps_per_env": 24, "max_iterations": 9, "save_interval": 5, "experiment_name": "x",
    "actor": {"class_name": "MLPModel", "hidden_dims": [64, 32], "activation": "tanh", "obs_normalization": True,
              "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}},
    "critic": {"class_name": "MLPModel", "hidden_dims": [16], "activation": "tanh", "obs_normalization": True},
    "algorithm": {
        "value_loss_coef": 1.0, "clip_param": 0.2, "entropy_coef": 0.01, "num_learning_epochs": 5,
        "num_mini_batches": 4, "learning_rate": 1e-3, "gamma": 0.99, "lam": 0.95, "desired_kl": 0.01,
        "max_grad_norm": 1.0,
    },
}  # fmt: skip


def test_runner_of_rsl_rl_5():
    config = agent(RUNNER_5, Report())
    assert (config["actor"], config["critic"]) == (
        {"hidden": [64, 32], "activation": "tanh"},
        {"hidden": [16], "activation": "tanh"},
    )
    assert (config["init_std"], config["std"], config["normalize_observations"]) == (0.5, "log", True)
    with pytest.raises(ConfigError, match="'CNNModel' has no counterpart"):
        agent({**RUNNER_5, "actor": {**RUNNER_5["actor"], "class_name": "CNNModel"}}, Report())


CUDA = """
from isaaclab.managers import ManagerTermBase

class Stored(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.sum = torch.zeros(env.num_envs, device="cuda")

    def __call__(self, env):
        self.sum += torch.ones(env.num_envs).cuda()
        return self.sum

def sign(env):
    return torch.ones(env.num_envs, device="cuda:0") + env.scene["robot"].data.joint_pos[:, 0].to("cuda") * 0.0
"""


def test_terms_that_name_the_device_cuda_run_on_the_cpu(tmp_path):
    rewards = {name: f"RewardTermCfg(func={name}, weight=1.0)" for name in ("Stored", "sign")}
    _, result = stepped(rover(tmp_path / "rover", CUDA, rewards=rewards))
    assert result.reward.device.type == "cpu"
    assert bool((result.reward > 0.0).all())


def test_soft_limits_may_be_wider_than_the_joint_range(tmp_path):
    spawn = "        spawn=sim_utils.UsdFileCfg("
    wide = (spawn, f"        soft_joint_pos_limit_factor=1.8,\n{spawn}")
    env, _ = stepped(rover(tmp_path / "rover", "", [wide]))
    assert env.config.scene.entities["robot"].soft_joint_pos_limit_factor == 1.8


def test_file_without_names_of_a_format_belongs_to_the_format_of_its_task(tmp_path, monkeypatch):
    folder = tmp_path / "rover"
    kernels = "import numpy as np\nimport warp as wp\n\nONE = np.ones(1)\n\n\n@wp.func\ndef f(x):\n    return x\n"
    (tmp_path / "kernels_of_test.py").write_text(kernels)
    added = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nimport kernels_of_test\n"
    find = namespace.importlib.util.find_spec
    monkeypatch.setattr(namespace.importlib.util, "find_spec", lambda name: None if name == "warp" else find(name))
    with pytest.raises(TaskError, match=r"kernels_of_test.py:7: warp.func cannot be used: .* not installed"):
        rover(folder, added)


class _Local(threading.local):
    """A class whose base of the standard library is written in C, as `typing.Generic` is from Python 3.12 on."""

    marker = 1


def test_source_of_a_direct_task_leaves_out_bases_without_source():
    assert "marker = 1" in direct_convert._source_of(_Local)


def test_installed_package_that_imports_isaac_lab(tmp_path, monkeypatch):
    site = tmp_path / "site"
    robots = site / "installed_robots_of_test"
    (robots / "arm").mkdir(parents=True)
    (robots / "__init__.py").write_text("from .arm import STIFFNESS\n")
    (robots / "arm" / "__init__.py").write_text("from isaaclab_tasks.utils import import_packages\n\nSTIFFNESS = 3.0\n")
    plain = site / "installed_numbers_of_test"
    plain.mkdir()
    (plain / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(site))
    code = "from installed_robots_of_test import STIFFNESS\nimport installed_numbers_of_test\n"
    stepped(rover(tmp_path / "tasks", code))
    own = [name for name in ("installed_robots_of_test", "installed_numbers_of_test") if name in OWN_NAMES]
    assert own == ["installed_robots_of_test"]


def test_installed_library_that_also_serves_a_framework_stays_itself(tmp_path, monkeypatch):
    library = tmp_path / "site" / "warp"
    library.mkdir(parents=True)
    (library / "__init__.py").write_text("from warp.kernels import func\n")
    (library / "kernels.py").write_text("def func(f):\n    return f\n")
    (library / "usd.py").write_text("from pxr import Usd\nimport omni.usd\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "warp"]:
        monkeypatch.delitem(sys.modules, name)
    stepped(rover(tmp_path / "rover", "import warp as wp\n\n@wp.func\ndef f(x):\n    return x\n"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "warp"]:
        del sys.modules[name]
