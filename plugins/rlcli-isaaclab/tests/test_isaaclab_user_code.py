"""Code of published tasks beyond Isaac Lab's public names: events on PhysX's view, forces, commands, and imports."""

import logging
import sys

import gymnasium
import mujoco
import pytest
import torch
from cartpole_files import write

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

torch.set_num_threads(1)
HEAD = """
import torch
import isaaclab.envs.mdp as mdp
import isaaclab.sim as sim_utils
from isaaclab.actuators import ImplicitActuatorCfg
from isaaclab.assets import ArticulationCfg
from isaaclab.envs import ManagerBasedRLEnvCfg
from isaaclab.managers import ActionTermCfg, CurriculumTermCfg, EventTermCfg, ObservationGroupCfg, ObservationTermCfg
from isaaclab.managers import RewardTermCfg, SceneEntityCfg, TerminationTermCfg
from isaaclab.scene import InteractiveSceneCfg
from isaaclab.utils import configclass

@configclass
class SceneCfg(InteractiveSceneCfg):
    robot = ArticulationCfg(
        prim_path="{ENV_REGEX_NS}/Robot",
        spawn=sim_utils.UsdFileCfg(usd_path="omniverse://somewhere/rover.usd"),
        actuators={
            "arm": ImplicitActuatorCfg(joint_names_expr=["arm"], stiffness=20.0, damping=1.0),
            "wheel": ImplicitActuatorCfg(joint_names_expr=["wheel"], stiffness=0.0, damping=2.0),
        },
    )

@configclass
class Actions:
    arm = mdp.JointPositionActionCfg(asset_name="robot", joint_names=["arm"])
    wheel = mdp.JointVelocityActionCfg(asset_name="robot", joint_names=["wheel"])

@configclass
class Observations:
    @configclass
    class Policy(ObservationGroupCfg):
        velocity = ObservationTermCfg(func=mdp.base_lin_vel)
    policy: Policy = Policy()

@configclass
class Terminations:
    time_out = TerminationTermCfg(func=mdp.time_out, time_out=True)

@configclass
class RoverEnvCfg(ManagerBasedRLEnvCfg):
    scene: SceneCfg = SceneCfg(num_envs=4, env_spacing=4.0)
    actions: Actions = Actions()
    observations: Observations = Observations()
    events: EVENTS
    rewards: REWARDS
    commands: COMMANDS
    curriculum: CURRICULUM
    terminations: Terminations = Terminations()

    def __post_init__(self):
        self.decimation, self.episode_length_s, self.sim.dt = 2, 1.0, 0.01
"""
ROVER = """
<mujoco><option gravity="0 0 0"/><worldbody><body name="base"><freejoint/><geom name="hull" type="box" size=".2 .1 .05"
mass="4"/><body name="upper"><joint name="arm" axis="0 1 0" damping="0.1"/><geom name="rod" size=".05" pos="0 0 .2"
mass="1"/></body><body name="round"><joint name="wheel" axis="0 1 0"/><geom name="tyre" size=".05" mass="1"/></body>
</body></worldbody></mujoco>
"""


def rover(folder, functions="", replaced=(), **sections):
    """Return the task of a file with the user's functions, terms as texts by section, and replaced parts."""
    folder.mkdir()
    text = HEAD
    for section in ("events", "rewards", "commands", "curriculum"):
        terms = sections.get(section) or (
            {"alive": "RewardTermCfg(func=mdp.is_alive, weight=1.0)"} if section == "rewards" else {}
        )
        lines = "\n".join(f"        {name} = {term}" for name, term in terms.items()) or "        pass"
        name = section.title()
        made = f"    @configclass\n    class {name}:\n{lines}\n    {section}: {name} = {name}()"
        text = text.replace(f"    {section}: {section.upper()}", made)
    file = folder / "rover_env.py"
    text = text.replace("@configclass\nclass SceneCfg", f"{functions}\n@configclass\nclass SceneCfg", 1)
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new, 1)
    file.write_text(text)
    (folder / "rover.xml").write_text(ROVER)
    (folder / "models.yaml").write_text("robot: rover.xml\n")
    return resolve(find_task(f"{file}:RoverEnvCfg"))


CHANGES = """
def change(env, env_ids, asset_cfg):
    view = env.scene[asset_cfg.name].root_physx_view
    rows = torch.tensor([1, 3])
    masses, inertias, coms = view.get_masses(), view.get_inertias(), view.get_coms()
    materials = view.get_material_properties()
    assert masses.shape == (4, 3) and inertias.shape == (4, 3, 9) and coms.shape == (4, 3, 7)
    masses[:, 0] *= 2.0
    inertias[:, 1] *= 3.0
    coms[:, 0, 0] += 0.05
    materials[..., :2] = 0.3
    view.set_masses(masses, rows)
    view.set_inertias(inertias, rows)
    view.set_coms(coms, rows)
    view.set_material_properties(materials, rows)
"""
STARTUP = "EventTermCfg(func=change, mode='startup', params={'asset_cfg': SceneEntityCfg('robot')})"


def test_event_sets_masses_inertias_centres_and_frictions_of_some_environments(tmp_path):
    env = make_env(rover(tmp_path / "rover", CHANGES, events={"change": STARTUP}), seed=0)
    env.reset()
    first, second = (env.world(row)[0] for row in (0, 1))
    ids = [first.body(f"robot/{name}").id for name in ("base", "upper")]
    assert second.body_mass[ids[0]] == pytest.approx(2.0 * first.body_mass[ids[0]])
    assert second.body_inertia[ids[1]] == pytest.approx(3.0 * first.body_inertia[ids[1]])
    assert (second.body_ipos - first.body_ipos)[ids[0]] == pytest.approx([0.05, 0.0, 0.0])
    assert second.geom_friction[:, 0] == pytest.approx(0.3)
    assert first.geom_friction[:, 0] == pytest.approx(1.0)
    assert second.body_subtreemass[ids[0]] == pytest.approx(first.body_subtreemass[ids[0]] + 4.0)  # derived constants
    assert not first.body_simple[ids].any()


PUSH = """
def push(env, env_ids, asset_cfg):
    count = len(asset_cfg.body_ids) if isinstance(asset_cfg.body_ids, list) else 99
    force = torch.zeros(len(env_ids), count, 3)
    force[..., 0] = 12.0
    robot = env.scene["robot"]
    robot.set_external_force_and_torque(
        force, torch.zeros_like(force), env_ids=env_ids, body_ids=asset_cfg.body_ids, is_global=True
    )
"""


def test_force_of_an_event_acts_in_every_physics_step(tmp_path):
    params = "{'asset_cfg': SceneEntityCfg('robot', body_names='base')}"
    event = f"EventTermCfg(func=push, mode='interval', interval_range_s=(0.0, 0.0), params={params})"
    env = make_env(rover(tmp_path / "rover", PUSH, events={"push": event}), seed=0)
    env.reset()
    for _ in range(11):  # the event acts from the second step on
        env.step(torch.zeros(4, 2))
    model, data = env.world(0)
    mujoco.mj_subtreeVel(model, data)
    assert 6.0 * data.subtree_linvel[0, 0] == pytest.approx(12.0 * 10 * 0.02, rel=0.01)  # momentum


LEVELS = """
@configclass
class LevelCommandCfg(mdp.UniformVelocityCommandCfg):
    limit: float = 0.5

def widen(env, env_ids):
    cfg = env.command_manager.get_term("speed").cfg
    cfg.ranges.lin_vel_x = (cfg.limit, cfg.limit)
    return torch.tensor(cfg.ranges.lin_vel_x[1]) + env.reward_manager._episode_sums["alive"].mean()
"""
SPEED = """LevelCommandCfg(asset_name="robot", resampling_time_range=(0.1, 0.1), ranges=LevelCommandCfg.Ranges(
            lin_vel_x=(0.0, 0.0), lin_vel_y=(0.0, 0.0), ang_vel_z=(0.0, 0.0)), heading_command=False)"""


def test_curriculum_changes_the_ranges_of_a_command(tmp_path):
    made = rover(
        tmp_path / "rover", LEVELS, commands={"speed": SPEED}, curriculum={"widen": "CurriculumTermCfg(func=widen)"}
    )
    env = make_env(made, seed=0)
    env.reset()
    for _ in range(52):  # curricula run when an episode ends
        env.step(torch.zeros(4, 2))
    assert env.command_manager.get_command("speed")[:, 0].tolist() == [0.5] * 4


RAMP = """
from isaaclab.managers import ManagerTermBase

class ramp(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.settings = env.reward_manager.get_term_cfg("alive")
        assert self.settings.weight == 1.0

    def __call__(self, env, env_ids, weight):
        self.settings.weight = weight
        env.reward_manager.set_term_cfg("alive", self.settings)
        return self.settings.weight
"""


def test_curriculum_class_reads_a_reward_in_its_constructor(tmp_path):
    ramp = "CurriculumTermCfg(func=ramp, params={'weight': 3.0})"
    env = make_env(rover(tmp_path / "rover", RAMP, curriculum={"ramp": ramp}), seed=0)
    env.reset()
    rewards = [env.step(torch.zeros(4, 2)).reward.tolist() for _ in range(52)]  # curricula run when an episode ends
    assert rewards[0] == pytest.approx([0.02] * 4)
    assert rewards[-1] == pytest.approx([0.06] * 4)


DEFAULTS = """
def bodies(env, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot", body_names=())):
    height = env.scene.terrain.env_origins[:, 2]
    count = env.scene["robot"].data.body_pos_w[:, asset_cfg.body_ids].shape[1]
    return count - height
"""
PLANE = """
    from isaaclab.terrains import TerrainImporterCfg
    terrain = TerrainImporterCfg(prim_path="/World/ground", terrain_type="plane")
    robot ="""


def test_default_without_names_selects_all_and_a_plane_has_origins(tmp_path):
    reward = "RewardTermCfg(func=bodies, weight=1.0)"
    plane = ("    robot =", PLANE)
    env = make_env(rover(tmp_path / "rover", DEFAULTS, [plane], rewards={"bodies": reward}), seed=0)
    env.reset()
    assert env.step(torch.zeros(4, 2)).reward.tolist() == pytest.approx([0.06] * 4)


def test_gains_of_joints_with_and_without_stiffness(tmp_path):
    params = """{'asset_cfg': SceneEntityCfg('robot', joint_names=['.*']), 'operation': 'scale',
        'stiffness_distribution_params': (2.0, 2.0), 'damping_distribution_params': (3.0, 3.0)}"""
    event = f"EventTermCfg(func=mdp.randomize_actuator_gains, mode='startup', params={params})"
    env = make_env(rover(tmp_path / "rover", events={"gains": event}), seed=0)
    env.reset()
    model = env.world(0)[0]
    found = {name: model.actuator(f"robot/{name}").biasprm[1:3].tolist() for name in ("arm", "wheel")}
    assert found["arm"] == pytest.approx([-40.0, -3.0])
    assert found["wheel"] == pytest.approx([0.0, -6.0])


REWARD = """
def needs_a_command(env):
    speed = env.command_manager.get_command("speed")[:, 0]
    assert (speed > 0).all(), "the command must be positive"
    return speed
"""


def test_reward_that_needs_the_first_reset(tmp_path):
    command = (
        SPEED.replace("Level", "Uniform")
        .replace("Uniform", "mdp.UniformVelocity")
        .replace("lin_vel_x=(0.0, 0.0)", "lin_vel_x=(1.0, 1.0)")
    )
    reward = "RewardTermCfg(func=needs_a_command, weight=1.0)"
    env = make_env(rover(tmp_path / "rover", REWARD, rewards={"speed": reward}, commands={"speed": command}), seed=0)
    env.reset()
    assert env.step(torch.zeros(4, 2)).reward.tolist() == pytest.approx([0.02] * 4)


SPAWNER = """
@configclass
class OwnFileCfg(sim_utils.UsdFileCfg):
    activate_contact_sensors: bool = True
    rigid_props = sim_utils.RigidBodyPropertiesCfg(disable_gravity=False)
    usd_path: str = "omniverse://somewhere/rover.usd"

    def __post_init__(self):
        self.scale = (1.0, 1.0, 1.0)


first, second = OwnFileCfg(), OwnFileCfg(activate_contact_sensors=False)
first.rigid_props.disable_gravity = True
assert first.activate_contact_sensors and not second.activate_contact_sensors
assert not second.rigid_props.disable_gravity
"""


def test_subclass_of_a_spawner(tmp_path, monkeypatch):
    usual = 'sim_utils.UsdFileCfg(usd_path="omniverse://somewhere/rover.usd")'
    monkeypatch.setattr(sys.modules[__name__], "HEAD", HEAD.replace(usual, "OwnFileCfg()"))
    assert rover(tmp_path / "rover", SPAWNER).task.scene.entities["robot"].model.endswith("rover.xml")


# --- imports ---


@pytest.fixture
def unchanged(tmp_path):
    """Return the package `source/balance_own` with Isaac Lab's own imports."""
    before = set(sys.modules)
    gymnasium.registry.pop("Template-Cartpole-v0", None)
    folder = tmp_path / "source" / "balance_own"
    folder.mkdir(parents=True)
    write(folder)
    for file in folder.rglob("*.py"):
        text = file.read_text().replace("rlcli_isaaclab.rsl_rl", "isaaclab_rl.rsl_rl")
        file.write_text(text.replace("rlcli_isaaclab", "isaaclab"))
    yield folder
    gymnasium.registry.pop("Template-Cartpole-v0", None)
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in ("source", "balance_own"):
            del sys.modules[name]


def steps(folder, name=""):
    env = make_env(resolve(find_task(f"{folder}{name}")).with_num_envs(2), seed=0)
    env.reset()
    env.step(torch.zeros(2, 1))


@pytest.mark.filterwarnings("ignore:.*Overriding environment")  # the package is imported under two names
def test_import_by_a_path_from_the_repositorys_root(unchanged):
    file = unchanged / "cartpole_env_cfg.py"
    file.write_text(file.read_text().replace("from . import mdp", "import source.balance_own.mdp as mdp"))
    steps(unchanged)


def test_private_function_and_module_of_an_earlier_version(unchanged):
    file = unchanged / "mdp" / "rewards.py"
    lines = """import torch
from isaaclab.envs.mdp.events import _randomize_prop_by_op
from isaaclab.controllers.pink_ik_cfg import PinkIKControllerCfg
"""
    file.write_text(file.read_text().replace("import torch\n", lines, 1))
    steps(unchanged)
    from rlcli_isaaclab.mdp import _randomize_prop_by_op as draw

    values = draw(torch.ones(3, 4), (2.0, 2.0), torch.tensor([0, 2]), torch.tensor([1]), "scale", "uniform")
    assert values.sum(dim=0).tolist() == [3.0, 5.0, 3.0, 3.0]
    assert draw(torch.ones(2, 2), (5.0, 5.0), None, slice(None), "add", "uniform").eq(6.0).all()


def test_environment_class_of_the_task_is_reported(unchanged):
    def notes():
        return [str(note) for note in resolve(find_task(str(unchanged))).notes if note.key == "entry_point"]

    assert notes() == []
    (unchanged / "envs.py").write_text(
        "from isaaclab.envs import ManagerBasedRLEnv as Env\n\n\nclass OwnEnv(Env):\n    pass\n"
    )
    start = unchanged / "__init__.py"
    start.write_text(start.read_text().replace("isaaclab.envs:ManagerBasedRLEnv", "balance_own.envs:OwnEnv"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "balance_own"]:
        del sys.modules[name]
    gymnasium.registry.pop("Template-Cartpole-v0", None)
    why = "terms can call methods of the task's own environment class; rlcli itself calls none of them"
    assert notes() == [f"entry_point: ignored: {why}"]


def test_agent_and_package_that_need_a_missing_library_are_left_out(unchanged, caplog):
    (unchanged / "agents" / "other.py").write_text("import a_missing_library\n")
    start = unchanged / "__init__.py"
    more = '"other_cfg_entry_point": f"{agents.__name__}.other:Cfg",\n        "rsl_rl_cfg_entry_point"'
    text = start.read_text().replace('"rsl_rl_cfg_entry_point"', more)
    start.write_text(f"{text}\nfrom isaaclab_tasks.utils import import_packages\nimport_packages(__name__, [])\n")
    broken = unchanged / "broken"
    broken.mkdir()
    (broken / "__init__.py").write_text("import a_missing_library\n")
    with caplog.at_level(logging.WARNING):
        resolved = resolve(find_task(str(unchanged)))
    notes = [str(note) for note in resolved.notes if note.key == "agents.other"]
    assert notes == ["agents.other: ignored: No module named 'a_missing_library'"]
    (record,) = [r.getMessage() for r in caplog.records if "left out" in r.getMessage()]
    assert record == f"balance_own.broken is left out: No module named 'a_missing_library' ({broken}/__init__.py:1)"
