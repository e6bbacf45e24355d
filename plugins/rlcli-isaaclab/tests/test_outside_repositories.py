"""Code of repositories that are built on Isaac Lab: their packages, term objects, actuators and sensors."""

import logging
import shutil
import sys
import warnings

import gymnasium
import pytest
import torch
from cartpole_files import write
from test_isaaclab_packages import stepped
from test_isaaclab_user_code import rover

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.envs.sharding.env import ShardedEnv
from rlcli.errors import ConfigError, TaskError
from rlcli.registry import find_task
from rlcli.scene.names import NameProblem
from rlcli_isaaclab import namespace

torch.set_num_threads(1)
ROBOT = "    robot = ArticulationCfg("


@pytest.fixture(autouse=True)
def forget_modules():
    known = set(sys.modules)
    yield
    for name in set(sys.modules) - known:
        if name.partition(".")[0] in ("farm", "carts", "pond", "lake", "balance_own"):
            del sys.modules[name]
    for task in ("Template-Cartpole-v0", "Pond-v0", "Lake-v0"):
        gymnasium.registry.pop(task, None)


def test_package_beside_the_package_of_the_task(tmp_path):
    tools = tmp_path / "tools_of_test"
    tools.mkdir()
    (tools / "__init__.py").write_text("from isaaclab.utils import configclass\n\nSTIFFNESS = 3.0\n")
    stepped(rover(tmp_path / "tasks", "from tools_of_test import STIFFNESS\n"))


OBJECTS = """
import functools

class Speed:
    def __init__(self):
        self.calls = 0

    def __call__(self, env, scale):
        self.calls += 1
        return scale * env.scene["robot"].data.joint_vel.abs().sum(dim=1) + self.calls

speed = Speed()
doubled = functools.partial(speed, scale=2.0)
"""


def test_terms_that_are_objects_and_partial_functions(tmp_path):
    rewards = {
        "speed": "RewardTermCfg(func=speed, weight=1.0, params={'scale': 1.0})",
        "doubled": "RewardTermCfg(func=doubled, weight=1.0)",
    }
    _, result = stepped(rover(tmp_path / "rover", OBJECTS, rewards=rewards))
    assert float(result.reward.min()) > 0.0


LATE = """
from isaaclab.actuators import ImplicitActuator

class HalfActuator(ImplicitActuator):
    def compute(self, control_action, joint_pos, joint_vel):
        control_action.joint_positions = 0.5 * control_action.joint_positions
        return super().compute(control_action, joint_pos, joint_vel)

@configclass
class HalfActuatorCfg(ImplicitActuatorCfg):
    class_type: type = HalfActuator
"""


def test_subclass_of_the_implicit_actuator_computes_the_efforts(tmp_path):
    own = ('"arm": ImplicitActuatorCfg(joint_names_expr=["arm"]', '"arm": HalfActuatorCfg(joint_names_expr=["arm"]')
    resolved = rover(tmp_path / "rover", LATE, [own])
    (note,) = [note for note in resolved.notes if note.key == "scene.robot.actuators.arm.class_type"]
    assert note.status == "approximated"
    env, _ = stepped(resolved, steps=60)
    # the target 0.5 is halved by the user's class
    assert env.entities["robot"].data.joint_pos[:, 0].mean() == pytest.approx(0.25, abs=0.03)


def test_drive_without_effort_does_nothing(tmp_path):
    own = ("stiffness=0.0, damping=2.0", "stiffness=0.0, damping=2.0, effort_limit=0.0")
    action = ('    wheel = mdp.JointVelocityActionCfg(asset_name="robot", joint_names=["wheel"])\n', "")
    resolved = rover(tmp_path / "rover", "", [own, action])
    assert "wheel" not in (resolved.task.scene.entities["robot"].joints or {})
    stepped(resolved)


SHAPES = """
def shapes(env):
    asset = env.scene["robot"]
    paths = asset.root_physx_view.link_paths[0]
    counts = [asset._physics_sim_view.create_rigid_body_view(path).max_shapes for path in paths]
    assert paths[1].endswith("/upper") and counts == [1, 1, 1] and sum(counts) == asset.root_physx_view.max_shapes
    return torch.ones(env.num_envs)
"""


def test_number_of_shapes_of_each_body(tmp_path):
    stepped(rover(tmp_path / "rover", SHAPES, rewards={"own": "RewardTermCfg(func=shapes, weight=1.0)"}))


def test_names_that_files_use_while_they_are_imported(tmp_path):
    code = """
from isaaclab.envs.mdp import *
from isaaclab.sim.utils import apply_nested, clone
from isaaclab.utils.version import compare_versions, get_isaac_sim_version
from isaacsim.core.version import get_version
from isaaclab.terrains import MeshRepeatedBoxesTerrainCfg

@clone
@apply_nested
def spawn_own(prim_path, cfg, *args):
    return prim_path

assert int(get_version()[2]) == get_isaac_sim_version().major and compare_versions("5.0.0", "4.10.0") == 1
assert ActionTermCfg and Articulation and math_utils.wrap_to_pi and sim_utils.SphereCfg and math.pi and Sequence
boxes = MeshRepeatedBoxesTerrainCfg.ObjectCfg(num_objects=3, height=0.1, size=(0.1, 0.1))
"""
    stepped(rover(tmp_path / "rover", code))


def test_section_without_configclass_has_no_terms(tmp_path):
    plain = ("    @configclass\n    class Curriculum:", "    class Curriculum:")
    stage = "CurriculumTermCfg(func=mdp.modify_reward_weight, params={})"
    resolved = rover(tmp_path / "rover", "", [plain], curriculum={"more": stage})
    (note,) = [note for note in resolved.notes if note.key == "curriculum"]
    assert (note.status, resolved.task.curriculum) == ("ignored", {})
    assert note.text == "the class Curriculum has no @configclass: Isaac Lab reads no terms of it"


CHOSEN = """
def chosen(env, asset_cfg, number: int):
    assert number == 0.5
    assert len(asset_cfg.body_ids) == 3 and isinstance(asset_cfg.joint_ids, slice)
    return torch.ones(env.num_envs)
"""


def test_regex_of_all_bodies_gives_ids_and_a_list_of_all_names_gives_a_slice(tmp_path):
    entity = "SceneEntityCfg('robot', body_names='.*', joint_names=['arm', 'wheel'])"
    term = f"RewardTermCfg(func=chosen, weight=1.0, params={{'asset_cfg': {entity}, 'number': 0.5}})"
    stepped(rover(tmp_path / "rover", CHOSEN, rewards={"own": term}))


NONE = """
def none(env, asset_cfg):
    return env.scene["robot"].data.body_pos_w[:, asset_cfg.body_ids].sum(dim=(1, 2)) + 1.0
"""


def test_empty_list_of_bodies_selects_none(tmp_path):
    entity = "SceneEntityCfg('robot', body_names=[])"
    term = f"RewardTermCfg(func=none, weight=1.0, params={{'asset_cfg': {entity}}})"
    _, result = stepped(rover(tmp_path / "rover", NONE, rewards={"own": term}))
    assert result.reward.tolist() == pytest.approx([0.02] * 4)


RAYS = """
from isaaclab.assets import AssetBaseCfg
from isaaclab.sensors import RayCasterCfg, patterns

def fan(cfg, device):
    angles = torch.linspace(-0.5, 0.5, cfg.count, device=device)
    rays = torch.stack([angles.sin(), 0.0 * angles, -angles.cos()], dim=1)
    return torch.zeros_like(rays), rays

@configclass
class FanCfg:
    func: object = fan
    count: int = 5

def distances(env):
    hits = env.scene["rays"].data.ray_hits_w
    assert hits.clone().view(env.num_envs, -1).shape == (env.num_envs, 3 * env.scene["rays"].num_rays)
    return (hits - env.scene["rays"].data.pos_w[:, None]).norm(dim=-1).sum(dim=1)
"""
LIDAR = (
    "patterns.LidarPatternCfg(channels=2, vertical_fov_range=(-30, -20), horizontal_fov_range={}, horizontal_res=90)"
)


@pytest.mark.parametrize(
    ("pattern", "count", "first"),
    [
        (LIDAR.format("(-180, 180)"), 8, [-0.8660254, 0.0, -0.5]),
        (LIDAR.format("(-90, 90)"), 6, [0.0, -0.8660254, -0.5]),
        ("patterns.BpearlPatternCfg(horizontal_res=90.0)", 4 * 32, [0.0087265, 0.0, 0.9999619]),
        ("FanCfg()", 5, [-0.4794255, 0.0, -0.8775826]),
    ],
)
def test_patterns_of_rays(tmp_path, pattern, count, first):
    sensor = (
        f"    rays = RayCasterCfg(prim_path='{{ENV_REGEX_NS}}/Robot/base', mesh_prim_paths=[], pattern_cfg={pattern})"
    )
    reward = {"far": "RewardTermCfg(func=distances, weight=1.0)"}
    ground = "    ground = AssetBaseCfg(prim_path='/World/ground', spawn=sim_utils.GroundPlaneCfg())"
    resolved = rover(tmp_path / "rover", RAYS, [(ROBOT, f"{ground}\n{sensor}\n{ROBOT}")], rewards=reward)
    rays = resolved.task.scene.sensors["rays"].pattern
    assert (len(rays), list(rays[0])) == (count, pytest.approx(first, abs=1e-6))
    _, result = stepped(resolved)
    assert bool(result.reward.isfinite().all())


def test_rotation_of_rays_from_one_point(tmp_path):
    offset = "offset=RayCasterCfg.OffsetCfg(rot=(0.7071068, 0.0, 0.0, 0.7071068))"  # 90 degrees about z
    pattern = LIDAR.format("(0, 0)")
    path = "prim_path='{ENV_REGEX_NS}/Robot/base', mesh_prim_paths=[]"
    sensor = f"    rays = RayCasterCfg({path}, {offset}, pattern_cfg={pattern})"
    resolved = rover(tmp_path / "rover", RAYS, [(ROBOT, f"{sensor}\n{ROBOT}")])
    first = list(resolved.task.scene.sensors["rays"].pattern[0])
    assert first == pytest.approx([0.0, 0.8660254, -0.5], abs=1e-6)


@pytest.mark.parametrize("line", ["from . import pond", "from .pond import PondCfg", "import carts.pond as pond"])
def test_task_is_found_beside_a_task_that_cannot_be_imported(tmp_path, caplog, line):
    package = write(tmp_path / "carts")
    pond = package / "pond"
    pond.mkdir()
    (pond / "__init__.py").write_text("import gymnasium\n\nraise ValueError('no water')\n")
    start = package / "__init__.py"
    more = "\ngymnasium.register('Pond-v0', entry_point='x', kwargs={'env_cfg_entry_point': %s})\n"
    name = "PondCfg" if "PondCfg" in line else "pond.PondCfg"
    start.write_text(f"import gymnasium\n{line}\n{start.read_text()}{more % name}")
    with caplog.at_level(logging.WARNING):
        assert resolve(find_task(f"{package}:Template-Cartpole-v0")).task.rewards
    assert f"carts.pond is left out: no water ({pond}/__init__.py:3)" in [r.getMessage() for r in caplog.records]
    with pytest.raises(TaskError, match=rf"ValueError: no water \({pond}/__init__.py:3\)"):
        resolve(find_task(f"{package}:Pond-v0"))


def test_file_that_its_package_imports_under_another_name_is_imported_once(tmp_path):
    reach = tmp_path / "farm" / "tasks" / "reach"
    write(reach)
    (tmp_path / "farm" / "__init__.py").write_text("")
    start = reach / "__init__.py"
    start.write_text(f"{start.read_text()}\nimport farm.tasks.reach.cartpole_env_cfg\n")
    file = next(file for file in reach.glob("*.py") if "class CartpoleEnvCfg" in file.read_text())
    start.write_text(start.read_text().replace("cartpole_env_cfg\n", f"{file.stem}\n"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Gymnasium warns if a task is registered twice
        resolve(find_task(f"{file}:CartpoleEnvCfg"))
    names = [name for name, module in sys.modules.items() if getattr(module, "__file__", None) == str(file)]
    assert len({id(sys.modules[name]) for name in names}) == 1


def test_task_that_only_a_package_below_registers(tmp_path):
    (tmp_path / "carts" / "tasks").mkdir(parents=True)
    write(tmp_path / "carts" / "tasks" / "balance")
    for folder in ("carts", "carts/tasks"):
        (tmp_path / folder / "__init__.py").write_text("")
    assert resolve(find_task(f"{tmp_path / 'carts'}:Template-Cartpole-v0")).task.rewards


PHASE = """
from isaaclab.envs import ManagerBasedRLEnv

class RoverEnv(ManagerBasedRLEnv):
    def __init__(self, cfg, render_mode=None, **kwargs):
        self.period = 0.5
        super().__init__(cfg, render_mode, **kwargs)
        self.offset = torch.ones(self.num_envs)

    def phase(self):
        return self.offset + self.episode_length_buf * self.step_dt / self.period

def in_phase(env):
    return env.phase()
"""


def test_term_calls_a_method_of_the_own_environment_class(tmp_path):
    reward = {"own": "RewardTermCfg(func=in_phase, weight=1.0)"}
    rover(tmp_path / "rover", PHASE, rewards=reward)
    package = shutil.copytree(tmp_path / "rover", tmp_path / "pond")
    file = package / "rover_env.py"
    register = "gymnasium.register('Pond-v0', entry_point=f'{__name__}:RoverEnv', kwargs={'env_cfg_entry_point': %s})"
    file.write_text(f"{file.read_text()}\nimport gymnasium\n{register % 'RoverEnvCfg'}\n")
    (package / "__init__.py").write_text("from . import rover_env\n")
    _, result = stepped(resolve(find_task(f"{package}:Pond-v0")))
    assert result.reward.tolist() == pytest.approx([0.02 * (1.0 + 3 * 0.02 / 0.5)] * 4)


STARTS = """
from isaaclab.envs import ManagerBasedRLEnv

class RoverEnv(ManagerBasedRLEnv):
    def __init__(self, cfg, render_mode=None, **kwargs):
        assert torch.get_num_threads() < 1000
        self.ones = torch.ones(cfg.scene.num_envs, device=cfg.sim.device)
        super().__init__(cfg, render_mode)

def ones(env):
    return env.ones
"""


def test_own_environment_class_creates_tensors_on_the_device_of_its_settings(tmp_path, monkeypatch):
    rover(tmp_path / "rover", STARTS, rewards={"own": "RewardTermCfg(func=ones, weight=1.0)"})
    package = shutil.copytree(tmp_path / "rover", tmp_path / "lake")
    file = package / "rover_env.py"
    register = "gymnasium.register('Lake-v0', entry_point=f'{__name__}:RoverEnv', kwargs={'env_cfg_entry_point': %s})"
    file.write_text(f"{file.read_text()}\nimport gymnasium\n{register % 'RoverEnvCfg'}\n")
    (package / "__init__.py").write_text("from . import rover_env\n")
    resolved = resolve(find_task(f"{package}:Lake-v0"))
    _, result = stepped(resolved)
    assert result.reward.tolist() == pytest.approx([0.02] * 4)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 5000)  # the class fails: so does each use of its members
    with pytest.raises(AssertionError):
        stepped(resolved)


MOTION = """
from dataclasses import MISSING

def far(env, goal, asset_cfg):
    return torch.full((env.num_envs,), float(goal))

def seeks(env):
    return env.scene["robot"].find_bodies("")[0]
"""
FAR = "RewardTermCfg(func=far, weight=1.0, params={'goal': MISSING, 'asset_cfg': SceneEntityCfg('robot')})"


def test_missing_setting_is_given_on_the_command_line(tmp_path):
    replaced = [("self.decimation, self.episode_length_s", "self.decimation, self.other")]
    with pytest.raises(ConfigError) as raised:
        rover(tmp_path / "a", MOTION, replaced, rewards={"far": FAR})
    assert "missing 'episode_length_s'" in str(raised.value)
    assert "rewards.far.params: missing 'goal'" in str(raised.value)
    task = find_task(f"{tmp_path / 'a' / 'rover_env.py'}:RoverEnvCfg")
    words = ["episode_length_s=2.0", "rewards.far.params.goal=3", "rewards.far.weight=2.0"]
    resolved = resolve(task, overrides=words)
    assert (resolved.task.episode_length_s, resolved.task.rewards["far"].weight) == (2.0, 2.0)
    _, result = stepped(resolved)
    assert result.reward.tolist() == pytest.approx([6.0 * 0.02] * 4)


def test_missing_and_empty_names_of_bodies_name_key_and_line(tmp_path):
    touch = "    touch = ContactSensorCfg(prim_path='{ENV_REGEX_NS}/Robot/.*')"
    replaced = [(ROBOT, f"{touch}\n{ROBOT}")]
    entity = "SceneEntityCfg('touch', body_names=MISSING)"
    forces = f"RewardTermCfg(func=mdp.contact_forces, weight=1.0, params={{'threshold': 1.0, 'sensor_cfg': {entity}}})"
    code = f"from isaaclab.sensors import ContactSensorCfg\n{MOTION}"
    with pytest.raises(ConfigError, match=r"rover_env.py:\d+: rewards.forces.params.sensor_cfg.body_names: missing"):
        rover(tmp_path / "a", code, replaced, rewards={"forces": forces})
    env = make_env(rover(tmp_path / "b", MOTION, rewards={"own": "RewardTermCfg(func=seeks, weight=1.0)"}), seed=0)
    env.reset()
    with pytest.raises(NameProblem, match=r"rover_env.py:\d+: no body matches ''"):
        env.step(torch.zeros(4, env.layout.action_size))


RUNNER = """
from isaaclab.utils import configclass
from isaaclab_rl.rsl_rl import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg

@configclass
class RunnerCfg(RslRlOnPolicyRunnerCfg):
    num_steps_per_env, max_iterations, save_interval, experiment_name = 8, 1, 1, "rover"
    obs_groups = {"actor": ["actor"], "critic": ["actor"]}
    distribution = RslRlMLPModelCfg.GaussianDistributionCfg(init_std=0.5)
    actor = RslRlMLPModelCfg(hidden_dims=[8], activation="elu", distribution_cfg=distribution)
    critic = RslRlMLPModelCfg(hidden_dims=[16], activation="elu")
    algorithm = RslRlPpoAlgorithmCfg(
        value_loss_coef=1.0, use_clipped_value_loss=True, clip_param=0.2, entropy_coef=0.01, num_learning_epochs=2,
        num_mini_batches=2, learning_rate=1e-3, schedule="adaptive", gamma=0.99, lam=0.95, desired_kl=0.01,
        max_grad_norm=1.0,
    )
"""


def test_runner_of_rsl_rl_5_with_its_observation_group(tmp_path):
    rover(tmp_path / "rover", "", [("policy: Policy = Policy()", "actor: Policy = Policy()")])
    (tmp_path / "rover" / "agents").mkdir()
    (tmp_path / "rover" / "agents" / "rsl_rl_cfg.py").write_text(RUNNER)
    resolved = resolve(find_task(f"{tmp_path / 'rover' / 'rover_env.py'}:RoverEnvCfg"))
    assert list(resolved.task.observations) == ["policy"]
    assert (resolved.agent.init_std, resolved.agent.critic.hidden) == (0.5, (16,))
    assert resolved.agent.critic_obs == ("policy",)


RECURRENT = ("RslRlMLPModelCfg, Rsl", "RslRlMLPModelCfg, RslRlRNNModelCfg, Rsl")
MEMORY = ', activation="elu", rnn_type="lstm", rnn_hidden_dim=6, rnn_num_layers=1'


def recurrent_runner(folder, *networks):
    """Return the rover task with RSL-RL 5's runner in which these networks, of actor and critic, have a memory."""
    rover(folder, "", [("policy: Policy = Policy()", "actor: Policy = Policy()")])
    (folder / "agents").mkdir()
    text = RUNNER.replace(*RECURRENT)
    for name in networks:
        start = text.index(f"    {name} = RslRlMLPModelCfg(")
        text = text[:start] + text[start:].replace("MLPModelCfg", "RNNModelCfg", 1).replace(
            ', activation="elu"', MEMORY, 1
        )
    (folder / "agents" / "rsl_rl_cfg.py").write_text(text)
    return resolve(find_task(f"{folder / 'rover_env.py'}:RoverEnvCfg"))


def test_recurrent_networks_of_rsl_rl_5(tmp_path):
    memory = recurrent_runner(tmp_path / "rover", "actor", "critic").agent.rnn
    assert (memory.type, memory.hidden, memory.layers) == ("lstm", 6, 1)


def test_recurrent_actor_beside_a_critic_without_memory_is_refused_at_its_line(tmp_path):
    with pytest.raises(ConfigError, match="the networks of actor and critic differ") as caught:
        recurrent_runner(tmp_path / "rover", "actor")
    assert "rsl_rl_cfg.py:" in str(caught.value)


GROUPS = """
    @configclass
    class Policy(ObservationGroupCfg):
        velocity = ObservationTermCfg(func=mdp.base_lin_vel)
        enable_corruption = True
    @configclass
    class Proprio(ObservationGroupCfg):
        velocity = ObservationTermCfg(func=mdp.joint_vel, noise=GaussianNoiseCfg(std=0.1))
        history_length = 3
        enable_corruption = False
    @configclass
    class Critic(ObservationGroupCfg):
        height = ObservationTermCfg(func=mdp.base_pos_z)
    policy: Policy = Policy()
    proprio: Proprio = Proprio()
    critic: Critic = Critic()
"""


def runner_of_groups(folder, groups):
    velocity = "        velocity = ObservationTermCfg(func=mdp.base_lin_vel)\n"
    start = f"    @configclass\n    class Policy(ObservationGroupCfg):\n{velocity}"
    old = f"{start}    policy: Policy = Policy()\n"
    rover(folder, "from isaaclab.utils.noise import GaussianNoiseCfg\n", [(old, GROUPS)])
    (folder / "agents").mkdir()
    text = RUNNER.replace('{"actor": ["actor"], "critic": ["actor"]}', groups)
    (folder / "agents" / "rsl_rl_cfg.py").write_text(text)
    return find_task(f"{folder / 'rover_env.py'}:RoverEnvCfg")


def test_actor_reads_several_observation_groups(tmp_path):
    groups = '{"policy": ["policy", "proprio"], "critic": ["policy", "proprio", "critic"]}'
    resolved = resolve(runner_of_groups(tmp_path / "rover", groups))
    assert resolved.agent.critic_obs == ("policy", "critic")
    env, result = stepped(resolved)
    assert result.obs["policy"].shape == (4, 3 + 3 * 2)
    assert torch.equal(result.obs["policy"][:, 3:], result.obs["proprio"])
    assert env.layout.observations["policy"][1].name == "proprio_velocity"


def test_actor_reads_another_group_only(tmp_path):
    groups = '{"policy": ["proprio"], "critic": ["critic"]}'
    resolved = resolve(runner_of_groups(tmp_path / "rover", groups))
    assert resolved.agent.critic_obs == ("critic",)
    _, result = stepped(resolved)
    assert torch.equal(result.obs["policy"], result.obs["proprio"])


def test_observation_group_that_does_not_exist(tmp_path):
    task = runner_of_groups(tmp_path / "rover", '{"policy": ["policy", "scan"]}')
    with pytest.raises(ConfigError, match=r"rsl_rl_cfg.py:5: obs_groups.policy: no observation group 'scan'"):
        resolve(task)


BUILT = """
from isaaclab.managers import ManagerTermBase

class Turns(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        actions, commands = env.action_manager, env.command_manager
        self.before = torch.zeros_like(actions.action)
        self.facts = actions.total_action_dim, actions.get_term("wheel").action_dim, commands.active_terms
        self.facts += commands.get_command("goal").shape, env.termination_manager.active_terms
        self.facts += env.event_manager.active_terms,

    def __call__(self, env):
        assert self.facts == (2, 1, ["goal"], (4, 3), ["time_out"], ["change"]), self.facts
        change = (env.action_manager.action - self.before).sum(dim=1)
        self.before = env.action_manager.action.clone()
        return change

class Early(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.names = env.observation_manager.active_terms

    def __call__(self, env):
        return torch.zeros(env.num_envs)

def change(env, env_ids):
    pass
"""
GOAL = """mdp.UniformVelocityCommandCfg(asset_name='robot', resampling_time_range=(1.0, 1.0), heading_command=False,
        ranges=mdp.UniformVelocityCommandCfg.Ranges(lin_vel_x=(0, 1), lin_vel_y=(0, 1), ang_vel_z=(0, 1)))"""


def test_constructor_of_a_term_reads_the_managers_created_before(tmp_path):
    sections = {
        "commands": {"goal": GOAL},
        "events": {"change": "EventTermCfg(func=change, mode='reset')"},
        "rewards": {"turns": "RewardTermCfg(func=Turns, weight=1.0)"},
    }
    env, result = stepped(rover(tmp_path / "rover", BUILT, **sections))
    assert result.reward.tolist() == pytest.approx([0.0] * 4)
    assert env.step(torch.ones(4, 2)).reward.tolist() == pytest.approx([2 * 0.5 * 0.02] * 4)


def test_manager_that_is_created_later_is_an_error_with_the_order(tmp_path):
    early = {"early": "RewardTermCfg(func=Early, weight=1.0)"}
    expected = r"rover_env.py:\d+: env has no 'observation_manager' yet: managers are created in the order commands"
    with pytest.raises(Exception, match=expected):
        make_env(rover(tmp_path / "rover", BUILT, rewards=early), seed=0)


def test_module_in_a_folder_without_init_beside_the_package(tmp_path):
    (tmp_path / "parts_of_test").mkdir()
    (tmp_path / "parts_of_test" / "arm.py").write_text("STIFFNESS = 3.0\n")
    stepped(rover(tmp_path / "tasks", "from parts_of_test.arm import STIFFNESS\n"))


def test_task_that_a_file_registers(tmp_path):
    rover(tmp_path / "rover")
    entry = "entry_point='isaaclab.envs:ManagerBasedRLEnv', kwargs={'env_cfg_entry_point': RoverEnvCfg}"
    file = tmp_path / "rover" / "register_tasks.py"
    file.write_text(f"import gymnasium\nfrom rover_env import RoverEnvCfg\n\ngymnasium.register('Pond-v0', {entry})\n")
    assert "alive" in resolve(find_task(f"{file}:Pond-v0")).task.rewards


LOW = """
from dataclasses import MISSING

def low(env, asset_cfg=SceneEntityCfg("robot", body_names=MISSING)):
    return torch.full((env.num_envs,), float(len(asset_cfg.body_ids)))
"""


def test_default_without_names_of_bodies_must_be_given(tmp_path):
    given = "RewardTermCfg(func=low, weight=1.0, params={'asset_cfg': SceneEntityCfg('robot', body_names=['upper'])})"
    _, result = stepped(rover(tmp_path / "a", LOW, rewards={"low": given}))
    assert result.reward.tolist() == pytest.approx([0.02] * 4)
    with pytest.raises(ConfigError, match=r"rover_env.py:\d+: rewards.low: missing key 'asset_cfg'"):
        rover(tmp_path / "b", LOW, rewards={"low": "RewardTermCfg(func=low, weight=1.0)"})


def test_mistake_of_an_agent_is_at_its_class_and_a_training_may_have_no_end(tmp_path):
    rover(tmp_path / "rover", "", [("policy: Policy = Policy()", "actor: Policy = Policy()")])
    agents = tmp_path / "rover" / "agents"
    agents.mkdir()
    file = agents / "rsl_rl_cfg.py"
    source = find_task(f"{tmp_path / 'rover' / 'rover_env.py'}:RoverEnvCfg")
    file.write_text(RUNNER.replace("= 8, 1, 1,", "= 8, 15000000000, 15000000000,"))
    assert resolve(source).agent.max_iterations == 15_000_000_000
    for name in [name for name, module in sys.modules.items() if getattr(module, "__file__", None) == str(file)]:
        del sys.modules[name]
    file.write_text(RUNNER.replace("= 8, 1, 1,", "= 8, -10, 1,"))
    with pytest.raises(ConfigError, match=r"agents/rsl_rl_cfg\.py:5: agents\.rsl-rl\.max_iterations: "):
        resolve(source)


@pytest.mark.skipif(torch.cuda.is_available(), reason="the tensor is on the GPU")
def test_tensor_on_cuda_while_a_file_is_imported(tmp_path):
    code = "LIMITS = torch.tensor([1.0], device='cuda:0')\nassert LIMITS.cuda().device.type == 'cpu'\n"
    stepped(rover(tmp_path / "rover", code))


@pytest.mark.parametrize("name", ["rover.usd", "somewhere/rover.usd", "omniverse://somewhere/rover.usd"])
def test_model_option_names_the_end_of_a_path(tmp_path, name):
    rover(tmp_path / "rover")
    (tmp_path / "rover" / "models.yaml").unlink()
    own = (tmp_path / "rover" / "rover.xml").rename(tmp_path / "own.xml")
    source = find_task(f"{tmp_path / 'rover' / 'rover_env.py'}:RoverEnvCfg")
    override = f'models."{name}"="{own}"'
    assert resolve(source, overrides=[override]).task.scene.entities["robot"].model == f"file:{own}"
    with pytest.raises(ConfigError, match=r"--model over\.usd: the scene has no 'over\.usd'"):
        resolve(source, overrides=[override, f'models."over.usd"="{own}"'])


def test_all_wrong_names_are_found_although_a_manager_is_absent(tmp_path):
    code = BUILT.replace("def change(env, env_ids):", "def change(env, env_ids, asset_cfg):") + (
        "\ndef still(env, asset_cfg):\n    return torch.zeros(env.num_envs)\n"
    )
    entity = "params={'asset_cfg': SceneEntityCfg('robot', body_names='%s')}"
    sections = {
        "commands": {"goal": GOAL},
        "events": {"change": f"EventTermCfg(func=change, mode='reset', {entity % 'fin'})"},
        "rewards": {
            "turns": "RewardTermCfg(func=Turns, weight=1.0)",
            "still": f"RewardTermCfg(func=still, weight=1.0, {entity % 'wing'})",
        },
    }
    resolved = rover(tmp_path / "rover", code, **sections)
    with pytest.raises(ConfigError) as caught:
        make_env(resolved, seed=0)
    assert [problem.path for problem in caught.value.problems] == ["events.change", "rewards.still"]


OWN_RSL_RL = """
from rsl_rl.algorithms import PPO, AmpOfTest
from rsl_rl.networks.of_test import Discriminator
from rsl_rl.utils import names_of_test

class OwnAlgorithm(AmpOfTest):
    pass

def loss(env):
    return Discriminator(env.num_envs).loss()
"""


def test_name_that_the_installed_rsl_rl_lacks_raises_when_it_is_used(tmp_path):
    stepped(rover(tmp_path / "a", OWN_RSL_RL))
    resolved = rover(tmp_path / "b", OWN_RSL_RL, rewards={"loss": "RewardTermCfg(func=loss, weight=1.0)"})
    expected = r"rover_env.py:\d+: rsl_rl.networks.of_test.Discriminator.loss cannot be used: the installed rsl_rl does"
    with pytest.raises(TaskError, match=expected):
        stepped(resolved)


def test_library_of_agents_in_a_repository_is_not_replaced(tmp_path):
    own = tmp_path / "rsl_rl_of_test" / "rsl_rl_of_test"
    own.mkdir(parents=True)
    (own / "__init__.py").write_text("NUMBER = 3\n")
    file = str(tmp_path / "tasks" / "rover_env.py")
    assert namespace._trainer_module("rsl_rl_of_test", file) is None
    assert sys.modules["rsl_rl_of_test"].NUMBER == 3
    absent = namespace._trainer_module("other_rl_of_test.modules", file)
    assert absent.ActorCritic.__name__ == "ActorCritic"


def test_message_has_the_name_that_a_package_has_in_its_files(tmp_path):
    package = write(tmp_path / "json")  # a package of this name is imported already
    (package / "parts.py").write_text("")
    start = package / "__init__.py"
    start.write_text(f"from json.parts import missing\n{start.read_text()}")
    with pytest.raises(TaskError, match=r"cannot import name 'missing' from 'json\.parts'"):
        resolve(find_task(f"{package}:Template-Cartpole-v0"))


def test_package_of_a_repository_with_the_name_of_isaac_labs_tasks(tmp_path, monkeypatch):
    original = tmp_path / "source" / "isaaclab_tasks" / "isaaclab_tasks"
    (original / "parts_of_lab").mkdir(parents=True)
    (original / "__init__.py").write_text("")
    (original / "parts_of_lab" / "__init__.py").write_text("NUMBER = 3\n")
    monkeypatch.setenv("RLCLI_ISAACLAB", str(tmp_path / "source"))
    own = tmp_path / "challenge" / "isaaclab_tasks"
    own.mkdir(parents=True)
    (own / "__init__.py").write_text("")
    (own / "own_parts_of_test.py").write_text("NUMBER = 4\n")
    lines = (
        "from isaaclab_tasks.parts_of_lab import NUMBER\nfrom isaaclab_tasks.own_parts_of_test import NUMBER as OWN\n"
    )
    rover(own / "rover_of_test", f"{lines}assert (NUMBER, OWN) == (3, 4)\n")
    (own / "packed").mkdir()
    lines += "import isaaclab_tasks.parts_of_lab as parts\nassert (NUMBER, OWN, parts.NUMBER) == (3, 4, 3)\n"
    (own / "packed" / "__init__.py").write_text(lines)
    (own / "packed" / "rover_env.py").write_text((own / "rover_of_test" / "rover_env.py").read_text())
    for file in ("rover.xml", "models.yaml"):
        shutil.copy(own / "rover_of_test" / file, own / "packed" / file)
    resolve(find_task(f"{own / 'packed' / 'rover_env.py'}:RoverEnvCfg"))


def test_missing_files_of_isaac_labs_tasks_are_named_with_the_setting(tmp_path, monkeypatch):
    monkeypatch.delenv("RLCLI_ISAACLAB", raising=False)
    module = "isaaclab_tasks.manager_based.manipulation.reach.reach_env_cfg"
    with pytest.raises(TaskError, match="cannot import name 'ReachEnvCfg'") as caught:
        rover(tmp_path / "rover", f"from {module} import ReachEnvCfg\n")
    assert "set RLCLI_ISAACLAB to its folder isaaclab/source" in str(caught.value.hint)


def test_settings_that_are_arrays(tmp_path):
    lines = "import numpy\n\nHEIGHT = numpy.array((0.0, 0.0, 0.7))\nAXES = torch.eye(3)\n"
    spawn = 'spawn=sim_utils.UsdFileCfg(usd_path="omniverse://somewhere/rover.usd"),'
    state = "init_state=ArticulationCfg.InitialStateCfg(pos=HEIGHT),"
    replaced = [(spawn, f"{spawn} {state}"), ("events: Events", "shape = HEIGHT\n    axes = AXES\n    events: Events")]
    resolved = rover(tmp_path / "rover", lines, replaced)
    assert resolved.task.scene.entities["robot"].pos == pytest.approx((0.0, 0.0, 0.7))
    ignored = [note.key for note in resolved.notes if note.status == "ignored"]
    assert {"shape", "axes"} <= set(ignored)


def test_registered_module_that_does_not_exist_is_named_with_the_registering_file(tmp_path):
    package = write(tmp_path / "carts")
    start = package / "__init__.py"
    more = "'Pond-v0', entry_point='x', kwargs={'env_cfg_entry_point': f'{__name__}.pond_cfg:PondCfg'}"
    start.write_text(f"{start.read_text()}\ngym.register({more})\n")
    with pytest.raises(TaskError, match=r"No module named 'carts\.pond_cfg'") as caught:
        resolve(find_task(f"{package}:Pond-v0"))
    assert caught.value.hint == f"{start} registers the task with this module; correct the module's name"


def test_registered_module_that_does_not_exist_below_a_folder_without_init(tmp_path):
    package = write(tmp_path / "farm" / "carts")
    start = package / "__init__.py"
    more = "'Lake-v0', entry_point='x', kwargs={'env_cfg_entry_point': 'farm.carts.lake_cfg:LakeCfg'}"
    start.write_text(f"{start.read_text()}\ngym.register({more})\n")
    with pytest.raises(TaskError, match=r"No module named 'farm\.carts\.lake_cfg'") as caught:
        resolve(find_task(f"{package}:Lake-v0"))
    assert caught.value.hint == f"{start} registers the task with this module; correct the module's name"


def in_folders(tmp_path, *, with_init=()):
    """Write the package farm/tasks/carts, which registers its modules by their full names; return its folder."""
    package = write(tmp_path / "farm" / "tasks" / "carts")
    start = package / "__init__.py"
    text = start.read_text().replace("{__name__}", "farm.tasks.carts")
    start.write_text(text.replace("{agents.__name__}", "farm.tasks.carts.agents"))
    for folder in with_init:
        (tmp_path / folder / "__init__.py").write_text("")
    return package


@pytest.mark.parametrize("with_init", [(), ("farm",)])
def test_entries_below_folders_without_init(tmp_path, with_init):
    task = f"{in_folders(tmp_path, with_init=with_init)}:Template-Cartpole-v0"
    resolved = resolve(find_task(task))
    assert "pole_pos" in resolved.task.rewards
    assert resolved.agent.num_steps == 16


def test_entries_below_folders_without_init_in_several_processes(tmp_path):
    task = f"{in_folders(tmp_path)}:Template-Cartpole-v0"
    env = ShardedEnv(resolve(find_task(task), overrides=["scene.num_envs=4"]), workers=2)
    try:
        env.reset()
        assert env.step(torch.zeros(4, 1)).reward.shape == (4,)
    finally:
        env.close()


def test_folder_without_init_is_refused_with_the_package_that_registers_the_task(tmp_path):
    package = in_folders(tmp_path)
    with pytest.raises(TaskError, match="there is no file") as caught:
        find_task(f"{tmp_path / 'farm'}:Template-Cartpole-v0")
    assert caught.value.hint == f"{package} registers the task; write {package}:Template-Cartpole-v0"
    with pytest.raises(TaskError, match="there is no file") as caught:
        find_task(f"{tmp_path / 'farm'}:Pond-v0")
    assert caught.value.hint is None


@pytest.mark.parametrize("setting", ["decimation", "scene"])
def test_setting_that_is_read_from_a_configclass_itself(tmp_path, setting):
    lines = f"\n@configclass\nclass LakeCfg(ManagerBasedRLEnvCfg):\n    decimation = 4\n\nREAD = LakeCfg.{setting}\n"
    with pytest.raises(TaskError, match=rf"'LakeCfg' has no attribute '{setting}' .*rover_env.py:\d+") as caught:
        rover(tmp_path / "rover", lines)
    assert caught.value.hint.endswith(f"as in Isaac Lab: write LakeCfg().{setting}")


def test_private_name_of_an_assets_data(tmp_path):
    code = "def speed(env):\n    robot = env.scene['robot']\n    return robot._data.joint_vel.abs().sum(dim=1)\n"
    stepped(rover(tmp_path / "rover", code, rewards={"speed": "RewardTermCfg(func=speed, weight=1.0)"}))
