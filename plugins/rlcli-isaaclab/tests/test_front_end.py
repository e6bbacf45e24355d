"""Tasks written for Isaac Lab in rlcli: equal numbers, equal steps, and their own terms."""

import itertools
import json
import subprocess
import sys

import pytest
import torch
from cartpole_files import ENV

from rlcli.config.dump import to_data
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, TaskError
from rlcli.registry import find_task
from rlcli.scene.names import NameProblem

torch.set_num_threads(1)


def assert_equal_state(ours, other):
    for field in ("qpos", "qvel"):
        ours.engine.field(field).copy_(other.engine.field(field))
    everyone = ours._select_all()
    ours.engine.forward(everyone)
    ours.sim.refresh()
    ours.episode_length_buf.copy_(other.episode_length_buf)


def test_env_equals_builtin_cartpole_step_by_step(package):
    ours = make_env(resolve(find_task(str(package())), flags={"scene.num_envs": 16}))
    other = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": 16}))
    ours.reset(seed=1), other.reset(seed=1)
    ended, timed_out = 0, 0
    generator = torch.Generator().manual_seed(3)
    for step in range(700):
        assert_equal_state(ours, other)
        action = (6.0 if step < 350 else 0.5) * torch.randn(16, 1, generator=generator)
        a, b = ours.step(action), other.step(action)
        assert torch.equal(a.reward, b.reward)
        assert torch.equal(a.terminated, b.terminated)
        assert torch.equal(a.truncated, b.truncated)
        going = ~(a.terminated | a.truncated)
        assert torch.equal(a.obs["policy"][going], b.obs["policy"][going])
        if not going.all():
            assert torch.equal(a.final_obs["policy"][~going], b.final_obs["policy"][~going])
        ended, timed_out = ended + int(a.terminated.sum()), timed_out + int(a.truncated.sum())
    assert ended > 0
    assert timed_out > 0


def test_config_equals_builtin_cartpole(package):
    ours = to_data(resolve(find_task(str(package()))))
    theirs = to_data(resolve(find_task("cartpole"), flags={"scene.num_envs": 4096}))
    assert ours["scene"]["entities"]["robot"].pop("model") == "cartpole:cartpole.xml"
    theirs["scene"]["entities"]["robot"].pop("model")
    theirs["scene"]["entities"]["robot"]["velocity_point"] = "com"
    for key in ("sim", "decimation", "episode_length_s", "scene", "actions", "observations", "terminations"):
        assert ours[key] == theirs[key], key
    own = ours["rewards"].pop("pole_pos")
    assert own == {
        "func": "joint_pos_target_l2",
        "weight": -1.0,
        "target": 0.0,
        "while_alive": False,
        "asset_cfg": {
            "name": "robot",
            "joint_names": ["cart_to_pole"],
            "body_names": None,
            "preserve_order": False,
        },
    }
    theirs["rewards"].pop("pole_pos")
    assert ours["rewards"] == theirs["rewards"]
    for a, b in zip(ours["events"].values(), theirs["events"].values(), strict=True):
        assert a.pop("position") == pytest.approx(b.pop("position"))
        assert a.pop("velocity") == pytest.approx(b.pop("velocity"))
        assert a == b


def test_runner_becomes_ppo_agent_with_rsl_rl_dialect(package):
    agent = to_data(resolve(find_task(str(package()))))["agents"]
    assert agent["default"] == "rsl-rl"
    wanted = {
        "trainer": "ppo", "dialect": "rsl_rl", "max_iterations": 150, "save_interval": 50, "num_steps": 16,
        "action_bound": None, "init_std": 1.0, "normalize_observations": False, "value_coef": 1.0,
        "clip_value": "larger", "clip_range": 0.2, "entropy_coef": 0.005, "num_epochs": 5, "num_minibatches": 4,
        "learning_rate": 1e-3, "schedule": "adaptive", "gamma": 0.99, "lam": 0.95, "desired_kl": 0.01,
        "max_grad_norm": 1.0, "std": "scalar", "bootstrap": "pre_step", "clip_grad": "separate",
        "actor": {"hidden": [32, 32], "activation": "elu"}, "critic": {"hidden": [32, 32], "activation": "elu"},
    }  # fmt: skip
    assert {key: agent["rsl-rl"][key] for key in wanted} == wanted


def test_files_without_package_import_each_other_and_agents_folder(package):
    folder = package("other")
    (folder / "__init__.py").unlink()
    resolved = resolve(find_task(f"{folder / 'cartpole_env_cfg.py'}:CartpoleEnvCfg"))
    assert resolved.agent_name == "rsl-rl"
    assert resolved.agent.num_steps == 16
    assert resolved.task.rewards["pole_pos"].params["asset_cfg"].joint_names == ["cart_to_pole"]


def test_folder_with_one_env_is_task_and_runner_beside_it_is_agent(package):
    folder = package("other")
    (folder / "__init__.py").unlink()
    (folder / "agents" / "rsl_rl_ppo_cfg.py").rename(folder / "rsl_rl_ppo_cfg.py")
    play = "from rlcli_isaaclab import *\nfrom cartpole_env_cfg import CartpoleEnvCfg\n\n@configclass\nclass Cfg_PLAY("
    (folder / "play_env_cfg.py").write_text(f"{play}CartpoleEnvCfg):\n    pass\n")
    resolved = resolve(find_task(str(folder)))
    assert (resolved.source.name, resolved.agent_name, resolved.agent.num_steps) == ("other", "rsl-rl", 16)
    (folder / "a_env_cfg.py").write_text(f"{play.replace('Cfg_PLAY', 'Tilted')}CartpoleEnvCfg):\n    pass\n")
    with pytest.raises(TaskError, match="contains several tasks") as caught:
        find_task(str(folder))
    assert "other/a_env_cfg.py:Tilted, other/cartpole_env_cfg.py:CartpoleEnvCfg" in caught.value.hint


def test_env_from_class_and_from_gymnasium_make(package):
    import gymnasium

    from rlcli_isaaclab import ManagerBasedRLEnv

    source = find_task(str(package()))
    resolve(source)
    cfg = sys.modules["balance.cartpole_env_cfg"].CartpoleEnvCfg()
    cfg.scene.num_envs = 4
    env = ManagerBasedRLEnv(cfg=cfg)
    obs, _ = env.reset(seed=0)
    assert obs["policy"].shape == (4, 4)
    obs, reward, terminated, truncated, extras = env.step(torch.zeros(4, 1))
    assert reward.shape == terminated.shape == truncated.shape == (4,)
    assert "log" in extras
    spec = gymnasium.registry["Template-Cartpole-v0"]
    spec.entry_point = "rlcli_isaaclab.envs:ManagerBasedRLEnv"
    made = gymnasium.make("Template-Cartpole-v0", cfg=cfg)
    again, _ = made.reset(seed=0)
    assert torch.equal(again["policy"], env.reset(seed=0)[0]["policy"])


TERMS = """
import torch

from rlcli_isaaclab import (
    CARTPOLE_CFG, ArticulationCfg, DoneTerm, EventTerm, ManagerBasedRLEnvCfg, ManagerTermBase, ObsGroup, ObsTerm,
    RewTerm, SceneEntityCfg, InteractiveSceneCfg, configclass, mdp, sample_uniform,
)


def positions(env, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot", joint_names=["cart_to_pole", "slider_to_cart"])):
    return env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids] - env.scene.env_origins[:, :1]


def time_left(env, scale: float):
    return scale * (env.max_episode_length - env.episode_length_buf).float().unsqueeze(1)


def acted(env):
    action = env.action_manager.action
    assert env.action_manager.total_action_dim == 1
    return torch.cat([action, env.action_manager.prev_action], dim=1)


def rel(env, asset_cfg: SceneEntityCfg):
    return mdp.joint_pos_rel(env, asset_cfg).square().sum(dim=1) + env.termination_manager.terminated


class Counter(ManagerTermBase):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.count = torch.zeros(env.num_envs, device=env.device)
        assert cfg.params["asset_cfg"].name == "robot"

    def reset(self, env_ids=None):
        self.count[env_ids] = 0.0

    def __call__(self, env, asset_cfg: SceneEntityCfg, step: float = 1.0):
        self.count += step
        return self.count.clone()


def start(env, env_ids, span, asset_cfg: SceneEntityCfg):
    asset = env.scene[asset_cfg.name]
    position = asset.data.default_joint_pos[env_ids] + sample_uniform(-span, span, (len(env_ids), 2), env.device)
    velocity = torch.full_like(position, 0.25)
    asset.write_joint_state_to_sim(position, velocity, env_ids=env_ids)
    assert torch.equal(asset.data.joint_pos[env_ids], position)


def late(env, steps: int):
    return env.episode_length_buf > steps


@configclass
class SceneCfg(InteractiveSceneCfg):
    robot: ArticulationCfg = CARTPOLE_CFG.replace(prim_path="{ENV_REGEX_NS}/Robot")


@configclass
class Actions:
    effort = mdp.JointEffortActionCfg(asset_name="robot", joint_names=["slider_to_cart"], scale=10.0)


@configclass
class Observations:
    @configclass
    class Policy(ObsGroup):
        joints = ObsTerm(func=positions)
        chosen = ObsTerm(func=positions, params={"asset_cfg": SceneEntityCfg(
            "robot", joint_names=["cart_to_pole", "slider_to_cart"], preserve_order=True)})
        left = ObsTerm(func=time_left, params={"scale": 2})
        actions = ObsTerm(func=acted)

    policy: Policy = Policy()


@configclass
class Events:
    begin = EventTerm(func=start, mode="reset", params={"span": 0.1, "asset_cfg": SceneEntityCfg("robot")})


@configclass
class Rewards:
    away = RewTerm(func=rel, weight=2.0, params={"asset_cfg": SceneEntityCfg("robot", joint_names=".*pole")})
    counter = RewTerm(func=Counter, weight=1.0, params={"asset_cfg": SceneEntityCfg("robot"), "step": 3})


@configclass
class Terminations:
    time_out = DoneTerm(func=mdp.time_out, time_out=True)
    too_late = DoneTerm(func=late, params={"steps": 5})


@configclass
class Cfg(ManagerBasedRLEnvCfg):
    scene: SceneCfg = SceneCfg(num_envs=3, env_spacing=4.0)
    observations: Observations = Observations()
    actions: Actions = Actions()
    events: Events = Events()
    rewards: Rewards = Rewards()
    terminations: Terminations = Terminations()

    def __post_init__(self):
        self.decimation, self.episode_length_s = 2, 5.0
        self.sim.dt = 0.01
"""


@pytest.fixture
def cfg(package):
    """Return cfg(*changes) -> source of a one-file task; each change is a pair (old text, new text)."""
    count = iter(range(100))

    def make(*changes):
        text = TERMS
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        name = f"own_{next(count)}"
        return find_task(f"{package('other', **{name: text}) / (name + '.py')}:Cfg")

    return make


def test_terms_with_isaac_lab_signature_run_unchanged(cfg):
    env = make_env(resolve(cfg()))
    obs = env.reset(seed=0)["policy"]
    joints = env.entities["robot"].data.joint_pos.clone()
    assert torch.equal(obs[:, :2], joints)  # without preserve_order: the model's order
    assert torch.equal(obs[:, 2:4], joints[:, [1, 0]])
    assert torch.equal(obs[:, 4], torch.full((3,), 500.0))  # 250 steps of 0.02 s, each counted as 2
    assert torch.allclose(env.entities["robot"].data.joint_vel, torch.tensor(0.25))
    assert float(joints.abs().max()) < 0.1
    step = env.step(torch.tensor([[1.0], [2.0], [3.0]]))
    assert torch.equal(step.obs["policy"][:, 5:], torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    pole = env.entities["robot"].data.joint_pos[:, 1]
    assert torch.allclose(step.reward, 0.02 * (2.0 * pole.square() + 3.0))
    for number in range(2, 7):
        step = env.step(torch.zeros(3, 1))
        assert bool(step.terminated.all()) == (number == 6)
    step = env.step(torch.zeros(3, 1))
    pole = env.entities["robot"].data.joint_pos[:, 1]
    assert torch.allclose(step.reward, 0.02 * (2.0 * pole.square() + 3.0))  # the counter was reset


def test_tensors_of_class_term_are_part_of_state(cfg):
    env = make_env(resolve(cfg()))
    env.reset(seed=0)
    for _ in range(3):
        env.step(torch.ones(3, 1))
    state = env.state_dict()
    first = env.step(torch.ones(3, 1)).reward
    env.step(torch.ones(3, 1))
    env.load_state_dict(state)
    assert torch.equal(env.step(torch.ones(3, 1)).reward, first)


COMMANDED = (
    ("    RewTerm, SceneEntityCfg,", "    CommandTerm, CommandTermCfg, CurrTerm, MISSING, RewTerm, SceneEntityCfg,"),
    ("\n\n\ndef positions", """


class Place(CommandTerm):
    \'\'\'Where the cart shall be.\'\'\'

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.robot, self.place = env.scene[cfg.asset_name], torch.zeros(self.num_envs, 1, device=self.device)
        self.metrics["error"] = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self):
        return self.place

    def _update_metrics(self):
        assert self.cfg.resampling_time_range[1] == 0.06
        self.metrics["error"] = (self.place[:, 0] - self.robot.data.joint_pos[:, 0]).abs()

    def _resample_command(self, env_ids):
        self.place[env_ids, 0] = torch.empty(len(env_ids)).uniform_(*self.cfg.ranges.x)

    def _update_command(self):
        pass


@configclass
class PlaceCfg(CommandTermCfg):
    class_type: type = Place
    asset_name: str = MISSING

    @configclass
    class Ranges:
        x: tuple[float, float] = MISSING

    ranges: Ranges = MISSING


@configclass
class Commands:
    place = PlaceCfg(asset_name="robot", resampling_time_range=(0.06, 0.06), ranges=PlaceCfg.Ranges(x=(1.0, 2.0)))


def off(env, command_name: str):
    assert env.command_manager.get_term(command_name).robot is env.scene["robot"]
    return env.command_manager.get_command(command_name)[:, 0]


def heavier(env, env_ids, term_name: str, weight: float):
    cfg = env.reward_manager.get_term_cfg(term_name)
    cfg.weight = weight
    env.reward_manager.set_term_cfg(term_name, cfg)
    return cfg.weight


@configclass
class Curriculum:
    heavier = CurrTerm(func=heavier, params={"term_name": "place", "weight": -3.0})


def positions"""),
    ("        actions = ObsTerm(func=acted)", """        actions = ObsTerm(func=acted)
        commands = ObsTerm(func=mdp.generated_commands, params={"command_name": "place"})"""),
    ("    counter = RewTerm(func=Counter, weight=1.0", """    place = RewTerm(
        func=off, weight=1.0, params={"command_name": "place"})
    counter = RewTerm(func=Counter, weight=0.0"""),
    ("func=rel, weight=2.0", "func=rel, weight=0.0"),
    ("    terminations: Terminations = Terminations()", """    terminations: Terminations = Terminations()
    commands: Commands = Commands()
    curriculum: Curriculum = Curriculum()"""),
)  # fmt: skip


def test_user_command_is_resampled_measured_and_saved(cfg):
    env = make_env(resolve(cfg(*COMMANDED), flags={"commands.place.ranges.x": [3.0, 4.0]}))
    torch.manual_seed(0)
    commands = [env.reset(seed=0)["policy"][:, -1].clone()]
    assert bool(((commands[0] >= 3.0) & (commands[0] <= 4.0)).all())
    commands += [env.step(torch.zeros(3, 1)).obs["policy"][:, -1].clone() for _ in range(4)]
    changed = [bool((a != b).all()) for a, b in itertools.pairwise(commands)]
    assert changed == [False, False, True, False]  # 0.06 s are three steps
    state = env.state_dict()
    first = env.step(torch.ones(3, 1))
    first_obs, first_reward = first.obs["policy"].clone(), first.reward.clone()
    env.reset(seed=1)
    env.load_state_dict(state)
    again = env.step(torch.ones(3, 1))
    assert torch.equal(first_obs, again.obs["policy"])
    assert torch.equal(first_reward, again.reward)
    ended = env.step(torch.zeros(3, 1)).episodes.ended()
    assert bool((ended.metrics["place/error"] > 2.5).all())


def test_user_curriculum_changes_reward_weight(cfg):
    env = make_env(resolve(cfg(*COMMANDED)))
    env.reset(seed=0)
    for number in range(1, 9):
        commands = env.command_manager.get_command("place")[:, 0].clone()
        step = env.step(torch.zeros(3, 1))
        weight = 1.0 if number <= 6 else -3.0  # the first episodes end after six steps
        assert torch.allclose(step.reward, 0.02 * weight * commands)
    assert env.extras() == {"Curriculum/heavier": -3.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('place = PlaceCfg(asset_name="robot", ', "place = PlaceCfg("), "commands.place: missing 'asset_name'"),
        (("x=(1.0, 2.0)", ""), r"commands\.place\.ranges: missing 'x'"),
        (("class_type: type = Place", "class_type: type = int"), "or write your own CommandTerm"),
        (('"term_name": "place"', '"term_name": "plaice"'), "no reward 'plaice'"),
    ],
)
def test_error_in_user_command_lists_valid_names(cfg, change, message):
    def live():
        env = make_env(resolve(cfg(*COMMANDED, change)))
        env.reset(seed=0)
        for _ in range(7):
            env.step(torch.zeros(3, 1))

    with pytest.raises((ConfigError, NameProblem), match=message):
        live()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"robot", joint_names=".*pole"', '"robot", joint_names="pol"'), "no joint matches 'pol'"),
        (('"robot", joint_names=".*pole"', '"robot", joint_names=[".*pole", "cart.*"]'), "matched twice"),
        (('"robot", joint_names=".*pole"', '"robo", joint_names=".*pole"'), "no 'robo' in the scene; did you mean"),
        (('{"steps": 5}', '{"step": 5}'), r"too_late\.params\.step: unknown key 'step'; did you mean 'steps'"),
        (('"span": 0.1', '"span": 0.1, "mu": 2'), "params.mu: unknown key 'mu'; 'start' takes span, asset_cfg"),
        (("func=start", "func=lambda env: 1"), r"events\.begin\.func: .* must take \(env, env_ids, \.\.\.\)"),
        (('joint_names=["slider_to_cart"], ', ""), "actions.effort: missing 'joint_names'"),
        (("func=rel, weight=2.0", "func=rel"), "other/own_0.py.*: rewards.away: missing 'weight'"),
        (("@configclass\nclass Rewards", "class Rewards"), "write @configclass above the class Rewards"),
        (("    too_late = ", "    x = mdp.time_out\n    too_late = "), "terminations.x: found a function"),
        (('{"steps": 5}', "{}"), "missing key 'steps'"),
        (
            ("    too_late = DoneTerm(func=late", "    late = DoneTerm(func=late)\n    two = DoneTerm(func=late"),
            "rename the member of the class that has the same name as the function",
        ),
        (('{"steps": 5}', '{"steps": "x"}'), "expected a whole number"),
        (("self.sim.dt = 0.01", "self.decimation = None"), "missing 'decimation'"),
        (("CARTPOLE_CFG.replace(", "CARTPOLE_CFG.replace(prim_pth=1, "), "ArticulationCfg has no setting 'prim_pth'"),
        (("func=mdp.time_out", "func=mdp.tim_out"), "did you mean 'time_out'"),
        (("mdp.JointEffortActionCfg(", "mdp.JointPositionToLimitsActionCfg("), "no position actuator drives"),
    ],
)  # fmt: skip
def test_error_in_config_lists_valid_names(cfg, change, message):
    with pytest.raises((ConfigError, TaskError), match=message):
        make_env(resolve(cfg(change)))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("import isaaclab.simm as sim_utils", "did you mean 'isaaclab.sim'"),
        ("from isaaclab.sim import UsdFileCgf", "did you mean 'UsdFileCfg'"),
        ("import omni.usd\nomni.usd.get_context()", "change the model (MJCF) instead"),
        ("from isaaclab.controllers import RmpFlowController as C\nC(1).initialize()", "DifferentialInverseKinematics"),
        ("from rlcli_isaaclab.managers import RewardTermConfig", "did you mean 'RewardTermCfg'"),
        ("from rlcli_isaaclab import sim\nsim.CubeCfg", "did you mean 'CuboidCfg'"),
        ("import no_such_module", None),
    ],
)
def test_missing_import_gives_replacement_line(cfg, line, message):
    with pytest.raises(TaskError, match=r"own_0\.py:[234](\)|: )") as caught:
        resolve(cfg(("\nimport torch\n", f"\n{line}\nimport torch\n")))
    assert caught.value.hint is None if message is None else message in caught.value.hint


def test_usd_file_is_mapped_or_error_lists_table(cfg):
    own = 'CARTPOLE_CFG.replace(spawn=UsdFileCfg(usd_path="/models/thing.usd"), '
    first = ("from rlcli_isaaclab import (", "from rlcli_isaaclab import (UsdFileCfg, map_usd,")
    with pytest.raises(
        ConfigError,
        match=r"scene\.robot\.spawn\.usd_path: no MJCF model is known for 'thing\.usd'",
    ):
        resolve(cfg(first, ("CARTPOLE_CFG.replace(", own)))
    known = ("\n\n\ndef positions", '\n\nmap_usd("models/thing.usd", "cartpole:cartpole.xml")\n\n\ndef positions')
    source = cfg(first, known, ("CARTPOLE_CFG.replace(", own))
    assert resolve(source).task.scene.entities["robot"].model == "cartpole:cartpole.xml"


def test_settings_without_counterpart_are_reported(cfg):
    spawn = (
        'CARTPOLE_CFG.replace(spawn=sim_utils.UsdFileCfg(usd_path="Robots/Cartpole/cartpole.usd",'
        " rigid_props=sim_utils.RigidBodyPropertiesCfg(max_depenetration_velocity=100.0)), "
    )
    changes = (
        ("from rlcli_isaaclab import (", "from rlcli_isaaclab import (sim_utils,"),
        ("CARTPOLE_CFG.replace(", spawn),
        ("self.sim.dt = 0.01", "self.sim.dt = 0.01\n        self.sim.physx.bounce_threshold_velocity = 0.2"),
    )
    ignored = {note.key for note in resolve(cfg(*changes)).notes if note.status == "ignored"}
    assert "sim.physx.bounce_threshold_velocity" in ignored or "sim.physx" in ignored
    assert any(key.startswith("scene.robot.spawn.rigid_props") for key in ignored)
    assert [note for note in resolve(cfg()).notes if not note.key.startswith("agent.")] == []


def test_package_with_several_tasks_requires_choice(package):
    start = (package() / "__init__.py").read_text()
    more = start + start[start.index("gym.register") :].replace("Template-Cartpole-v0", "Other-v0")
    folder = package("other", __init__=more)
    with pytest.raises(TaskError, match="registers 2 tasks"):
        resolve(find_task(str(folder)))
    assert find_task(f"{folder}:Other-v0").name == "Other-v0"
    assert resolve(find_task(f"{folder}:Other-v0")).task.decimation == 2
    with pytest.raises(TaskError, match="does not register a task 'No-v0'"):
        resolve(find_task(f"{folder}:No-v0"))


def test_configclass_copies_defaults_for_each_object():
    from rlcli_isaaclab import MISSING, configclass

    @configclass
    class Inner:
        values = [1, 2]  # noqa: RUF012
        limit: float = MISSING

    @configclass
    class Outer:
        inner: Inner = Inner()
        name = "a"

        def __post_init__(self):
            self.inner.limit = 3.0

    one, two = Outer(), Outer(name="b")
    one.inner.values.append(3)
    assert two.inner.values == [1, 2]
    assert two.to_dict() == {"inner": {"values": [1, 2], "limit": 3.0}, "name": "b"}
    assert one.replace(name="c").name == "c"
    with pytest.raises(TypeError, match="has no setting 'nam'"):
        one.replace(nam="c")


@pytest.mark.slow
def test_package_trains_resumes_and_evaluates(package, tmp_path):
    folder = package(cartpole_env_cfg=ENV.replace("num_envs=4096", "num_envs=64"))

    def rlcli(*words):
        done = subprocess.run(
            [sys.executable, "-m", "rlcli", *words, "--json", "--runs-dir", str(tmp_path / "runs")],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    run = rlcli("train", str(folder), "--max-iterations", "2", "--device", "cpu", "--logger", "none")["run"]
    assert rlcli("train", "--resume", "latest", "--max-iterations", "3", "--device", "cpu")["run"] == run
    assert rlcli("eval", "--checkpoint", run, "--episodes", "4", "--num-envs", "4")["episodes"] >= 4
