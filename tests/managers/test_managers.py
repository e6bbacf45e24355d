"""Binding of terms, and the results of each manager."""

import re

import pytest
import torch
import yaml
from support.worlds import CRITTER_TASK, PENDULUM_TASK, build, critter, edited, pendulum, run

from rlcli.errors import ConfigError, RlcliError, TaskError

CRITTER_REWARDS = list(yaml.safe_load(CRITTER_TASK)["rewards"])
JOINTS = ["hip_fl", "hip_fr", "hip_bl", "hip_br"]


def observed(tmp_path, **terms):
    env = build(critter(tmp_path, edited(CRITTER_TASK, observations={"policy": terms})), 3)
    env.reset()
    return env, env.step(torch.rand(3, 4)).obs["policy"]


def test_observation_columns_keep_written_order(tmp_path):
    order = ["hip_br", "hip_fl", "hip_bl", "hip_fr"]
    env, obs = observed(tmp_path, pos={"func": "joint_pos", "joints": order}, all={"func": "joint_pos"})
    assert torch.equal(obs[:, :4], obs[:, 4:][:, [JOINTS.index(name) for name in order]])
    assert env.layout.observations["policy"][0].elements == tuple(order)
    assert env.layout.observations["policy"][1].elements == tuple(JOINTS)


def test_patterns_expand_in_written_then_model_order(tmp_path):
    env, obs = observed(tmp_path, pos={"func": "joint_pos", "joints": ["hip_b.", "hip_f."]}, all={"func": "joint_pos"})
    assert env.layout.observations["policy"][0].elements == ("hip_bl", "hip_br", "hip_fl", "hip_fr")
    assert torch.equal(obs[:, :4], obs[:, 4:][:, [2, 3, 0, 1]])


def test_actions_drive_joints_in_written_order(tmp_path):
    env = build(critter(tmp_path), 2)
    env.reset()
    env.step(torch.tensor([[1.0, 2.0, 3.0, 4.0]] * 2))
    assert env.layout.actions[0].elements == ("hip_br", "hip_fl", "hip_bl", "hip_fr")
    model = env.engine.model
    driven = [model.joint(int(j)).name.removeprefix("robot/") for j in model.actuator_trnid[:, 0]]
    target = dict(zip(driven, env.engine.field("ctrl")[0].tolist(), strict=True))
    # raw x 0.5 about the default pose
    assert target == pytest.approx({"hip_br": 0.5 - 0.1, "hip_fl": 1.0 + 0.1, "hip_bl": 1.5 + 0.1, "hip_fr": 2.0 - 0.1})


def test_action_is_scaled_then_offset_then_clipped(tmp_path):
    term = {"func": "joint_effort", "scale": 3.0, "offset": 1.0, "clip": [-2.0, 5.0]}
    env = build(pendulum(tmp_path, edited(PENDULUM_TASK, actions={"torque": term})))
    env.reset()
    env.step(torch.tensor([[1.0], [2.0], [-3.0]]))
    assert env.engine.field("ctrl")[:, 0].tolist() == [4.0, 5.0, -2.0]
    assert env.action_manager.action[:, 0].tolist() == [1.0, 2.0, -3.0]


def test_position_action_without_default_offset(tmp_path):
    legs = {"func": "joint_position", "use_default_offset": False, "offset": 0.25}
    env = build(critter(tmp_path, edited(CRITTER_TASK, actions={"legs": legs})), 1)
    env.reset()
    env.step(torch.zeros(1, 4))
    assert env.engine.field("ctrl")[0].tolist() == [0.25] * 4


def test_action_terms_take_columns_in_order(tmp_path):
    split = {"legs": {"func": "joint_position", "joints": ["hip_b."], "use_default_offset": False},
             "front": {"func": "joint_effort", "joints": ["hip_fr"], "scale": 2.0}}  # fmt: skip
    env = build(critter(tmp_path, edited(CRITTER_TASK, actions=split, rewards={"power": None})), 1)
    assert [t.size for t in env.layout.actions] == [2, 1]
    env.reset()
    env.step(torch.tensor([[0.1, 0.2, 0.3]]))
    robot = env.entities["robot"]
    position, motor = dict(robot.actuators_of("position")), dict(robot.actuators_of("motor"))
    ctrl = env.engine.field("ctrl")[0]
    assert [float(ctrl[position[2]]), float(ctrl[position[3]]), float(ctrl[motor[1]])] == pytest.approx([0.1, 0.2, 0.6])


def test_action_manager_keeps_current_and_previous_action(tmp_path):
    env = build(pendulum(tmp_path))
    env.reset()
    env.step(torch.full((3, 1), 0.5))
    env.step(torch.full((3, 1), 0.75))
    assert env.action_manager.prev_action[:, 0].tolist() == [0.5] * 3
    assert env.action_manager.action[:, 0].tolist() == [0.75] * 3


def test_observation_is_clipped_then_scaled(tmp_path):
    _, obs = observed(
        tmp_path,
        raw={"func": "joint_vel"},
        both={"func": "joint_vel", "clip": [-0.5, 0.25], "scale": 4.0},
        each={"func": "joint_vel", "scale": [1.0, 2.0, 3.0, -1.0]},
    )
    raw, both, each = obs.split(4, dim=1)
    assert torch.equal(both, raw.clamp(-0.5, 0.25) * 4.0)
    assert torch.equal(each, raw * torch.tensor([1.0, 2.0, 3.0, -1.0]))
    assert raw.abs().max() > 0.5


def test_observation_groups_are_separate(tmp_path):
    env = build(critter(tmp_path), 3)
    obs = env.reset()
    assert {group: tuple(value.shape) for group, value in obs.items()} == {"policy": (3, 22), "critic": (3, 8)}
    assert (env.layout.size(), env.layout.size("critic"), env.layout.action_size) == (22, 8, 4)


def test_final_obs_does_not_change_next_obs(tmp_path):
    env = build(critter(tmp_path), 3)
    for result in run(env, 35):
        if result.truncated.any():
            assert (result.final_obs["policy"][result.truncated] != result.obs["policy"][result.truncated]).any()


SHAPES = """
import torch
from rlcli.task import Entity


def scalar(env):
    return 1.0


def column(env, *, entity: Entity = "robot"):
    return entity.data.joint_pos


def flat(env, *, entity: Entity = "robot"):
    return entity.data.joint_pos[:, 0]


def cube(env, *, entity: Entity = "robot"):
    return entity.data.joint_pos[:, :, None]


class Fussy:
    def __init__(self, env, *, size: int) -> None:
        if size > 3:
            raise ValueError(f"size {size} is more than 3")

    def __call__(self):
        return torch.zeros(3)
"""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"rewards": {"bad": {"func": "scalar", "weight": 1.0}}},
            "rewards.bad: 'scalar' returned a value of type float; return {}(3,)",
        ),
        (
            {"rewards": {"bad": {"func": "column", "weight": 1.0}}},
            "rewards.bad: 'column' returned {}(3, 1); return {}(3,)",
        ),
        ({"success": {"bad": {"func": "column"}}}, "success.bad: 'column' returned {}(3, 1); return {}(3,)"),
        ({"terminations": {"bad": {"func": "column"}}}, "terminations.bad: 'column' returned {}(3, 1); return {}(3,)"),
        ({"observations": {"policy": {"bad": {"func": "flat"}}}}, "observations.policy.bad: 'flat' returned {}(3,)"),
        (
            {"observations": {"policy": {"bad": {"func": "cube"}}}},
            "observations.policy.bad: 'cube' returned {}(3, 1, 1)",
        ),
        (
            {"observations": {"policy": {"bad": {"func": "joint_pos", "scale": [1.0, 2.0]}}}},
            "observations.policy.bad.scale: scale has 2 values; give 1, or one for each of the term's columns (1)",
        ),
    ],
)
def test_shape_error_names_term_and_expected_shape(tmp_path, changes, message):
    pattern = re.escape(message.replace("{}", "a tensor of shape "))
    with pytest.raises(ConfigError, match=rf"task\.yaml:\d+:\d+: {pattern}"):
        build(pendulum(tmp_path, edited(PENDULUM_TASK, **changes), terms_py=SHAPES))


BAD = {
    "torch.zeros(1)": "a tensor of shape (1,)",
    "torch.zeros(())": "a tensor of shape ()",
    "torch.zeros(3, 2, 2)": "a tensor of shape (3, 2, 2)",
    "None": "a value of type NoneType",
    "torch.nested.nested_tensor([torch.zeros(1)] * 3)": "a tensor that is not dense",
    "torch.zeros({}, dtype=torch.complex64)": "a tensor of type torch.complex64",
}
"""Expression of a wrong value -> how the message names it."""
DENSE = {
    "torch.zeros({}).to_sparse()": "a tensor that is not dense",
    "torch.zeros({}, device='meta')": "a tensor that is not dense",
}
WANTED = {"rewards": "3", "terminations": "3", "observations": "3, 1", "success": "3"}
"""Section -> the shape of its terms."""


def with_value(tmp_path, section, first, later, steps):
    """Build a task with a term that returns one value, and another one after some calls; step it."""
    text = "import torch\ncalls = [0]\ndef evil(env):\n    calls[0] += 1\n    return {} if calls[0] < 4 else {}\n"
    term = {"func": "evil", **{"rewards": {"weight": 1.0}, "success": {"at_least": 0.0}}.get(section, {})}
    terms = {"policy": {"bad": term}} if section == "observations" else {"bad": term}
    terms_py = text.format(first.format(WANTED[section]), later.format(WANTED[section]))
    env = build(pendulum(tmp_path, edited(PENDULUM_TASK, **{section: terms}), terms_py=terms_py))
    obs = env.reset()
    for _ in range(steps):
        obs = env.step(torch.zeros(env.num_envs, 1)).obs
    return obs


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
@pytest.mark.parametrize("section", WANTED)
@pytest.mark.parametrize("value", [*BAD, *DENSE])
def test_bad_first_value_of_a_term_is_named(tmp_path, section, value):
    with pytest.raises(ConfigError, match=re.escape(f"bad: 'evil' returned {(BAD | DENSE)[value]}; return a tensor")):
        with_value(tmp_path, section, value, value, 0)


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
@pytest.mark.parametrize("section", WANTED)
@pytest.mark.parametrize("value", [*BAD, *DENSE])
def test_bad_value_of_a_later_step_is_named(tmp_path, section, value):
    good = "torch.zeros({})" if section != "terminations" else "torch.zeros({}, dtype=torch.bool)"
    with pytest.raises(ConfigError, match=re.escape(f"bad: 'evil' returned {(BAD | DENSE)[value]}; return a tensor")):
        with_value(tmp_path, section, good, value, 8)


@pytest.mark.parametrize("kind", ["float32", "float64", "float16", "bfloat16", "int64", "uint8", "bool"])
@pytest.mark.parametrize("section", WANTED)
def test_terms_may_return_numbers_of_any_type(tmp_path, section, kind):
    value = f"torch.ones({{}}, dtype=torch.{kind})"
    if section == "terminations" and "float" in kind:
        with pytest.raises(ConfigError, match=f"type torch.{kind}; return a tensor of shape .3,. of booleans"):
            with_value(tmp_path, section, value, value, 0)
    elif section != "success" or kind != "bool":
        obs = with_value(tmp_path, section, value, value, 8)
        assert obs["policy"].dtype == torch.float32


@pytest.mark.parametrize(
    "value", ["torch.ones({}, requires_grad=True) * 2", "torch.ones({}, dtype=torch.cfloat).conj().imag"]
)
@pytest.mark.parametrize("section", ["rewards", "observations", "success"])
def test_gradients_and_views_of_terms_are_resolved(tmp_path, section, value):
    with torch.enable_grad():
        obs = with_value(tmp_path, section, value, value, 210)
    assert not obs["policy"].requires_grad


def test_parameter_error_names_its_path(tmp_path):
    task = edited(PENDULUM_TASK, rewards={"bad": {"func": "fussy", "weight": 1.0, "size": 5}})
    with pytest.raises(ConfigError, match=r"task.yaml:\d+:\d+: rewards.bad: size 5 is more than 3"):
        build(pendulum(tmp_path, task, terms_py=SHAPES))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (["hip_fl", "hip_fl"], r"joint 'hip_fl' is matched twice; narrow the second pattern, 'hip_fl'"),
        (["hip_f.", "hip_fr"], r"joint 'hip_fr' is matched twice; narrow the second pattern, 'hip_fr'"),
        (["hip_f", "hip_fl"], r"no joint matches 'hip_f'; did you mean 'hip_f"),
        (["knee.*"], r"no joint matches 'knee.\*'.*joints: hip_fl, hip_fr, hip_bl, hip_br"),
        (["hip_("], r"'hip_\(' is neither the name of a joint nor a regular expression"),
        (["root"], r"no joint matches 'root'"),
    ],
)
@pytest.mark.parametrize("section", ["observations", "rewards"])
def test_unknown_joint_error_names_its_path(tmp_path, section, joints, message):
    term = {"func": "joint_pos", "joints": joints} if section == "observations" else {
        "func": "joint_vel_l2", "weight": 1.0, "joints": joints}  # fmt: skip
    changes = {"observations": {"policy": {"x": term}}} if section == "observations" else {"rewards": {"x": term}}
    with pytest.raises(ConfigError, match=message) as caught:
        build(critter(tmp_path, edited(CRITTER_TASK, **changes)))
    assert "task.yaml:" in str(caught.value)


def test_all_unknown_names_are_reported_at_once(tmp_path):
    changes = {
        "observations": {"policy": {"x": {"func": "joint_pos", "joints": ["a"]}}},
        "rewards": {"x": {"func": "joint_vel_l2", "weight": 1.0, "joints": ["b"]},
                    "y": {"func": "lin_vel_z_l2", "weight": 1.0, "entity": "robto"}},
        "terminations": {"x": {"func": "joint_pos_out_of_limit", "joints": ["c"]}},
        "events": {"x": {"func": "apply_external_force_torque", "mode": "reset", "bodies": ["d"]}},
        "actions": {"x": {"func": "joint_effort", "joints": ["e"]}},
    }  # fmt: skip
    with pytest.raises(ConfigError) as caught:
        build(critter(tmp_path, edited(CRITTER_TASK, **changes)))
    text = str(caught.value)
    assert len(caught.value.problems) == 6
    assert all(f"'{name}'" in text for name in "abcde")
    assert "did you mean 'robot'" in text


def test_broken_terms_file_raises_task_error(tmp_path):
    code = 'import no_such_module\n\n\ndef mine(env):\n    """(num_envs,)"""\n    return env.x\n'
    task = edited(PENDULUM_TASK, rewards={"x": {"func": "mine", "weight": 1.0}})
    with pytest.raises(TaskError, match=r"terms.py: cannot be imported: ModuleNotFoundError"):
        build(pendulum(tmp_path, task, terms_py=code))


MEMORY = '''
import torch
from rlcli.task import Entity


class StepsAlive:
    """Counts its own calls in each environment's episode."""

    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self.count = torch.zeros(env.num_envs)

    def __call__(self):
        self.count += 1
        return self.count.clone()

    def reset(self, selection):
        selection.write(self.count, 0.0)


class Seen:
    """Number of calls so far, as an observation."""

    def __init__(self, env) -> None:
        self.count = torch.zeros(env.num_envs, 1)

    def __call__(self):
        return self.count

    def reset(self, selection):
        selection.add(self.count, 1.0)
'''


def test_stateful_reward_is_reset_with_its_env(tmp_path):
    task = edited(PENDULUM_TASK, reward_dt_scaling=False, rewards={
        "alive": None, "terminating": None, "count": {"func": "steps_alive", "weight": 1.0}})  # fmt: skip
    env = build(pendulum(tmp_path, task, terms_py=MEMORY))
    env.reset()
    env.episode_length_buf[1] = 6
    rewards = [env.step(torch.zeros(3, 1)).reward.tolist() for _ in range(6)]
    assert [row[0] for row in rewards] == [1, 2, 3, 4, 5, 6]
    assert [row[1] for row in rewards] == [1, 2, 3, 4, 1, 2]


def test_stateful_observation_is_reset_with_its_env(tmp_path):
    task = edited(PENDULUM_TASK, observations={"policy": {"seen": {"func": "seen"}}})
    env = build(pendulum(tmp_path, task, terms_py=MEMORY))
    assert env.reset()["policy"][:, 0].tolist() == [1, 1, 1]
    env.episode_length_buf[1] = 9
    assert env.step(torch.zeros(3, 1)).obs["policy"][:, 0].tolist() == [1, 2, 1]


def test_while_alive_reward_is_zero_on_termination(tmp_path):
    rewards = {name: None for name in CRITTER_REWARDS}
    rewards |= {
        "always": {"func": "base_height_l2", "weight": 1.0, "target_height": 10.0},
        "alive": {"func": "base_height_l2", "weight": 1.0, "target_height": 10.0, "while_alive": True},
    }
    env = build(critter(tmp_path, edited(CRITTER_TASK, rewards=rewards, reward_dt_scaling=False)), 3)
    env.reset()
    env.engine.field("qpos")[1, 2] = -5.0
    env.episode_length_buf[2] = env.max_episode_length - 1
    result = env.step(torch.zeros(3, 4))
    assert result.terminated.tolist() == [False, True, False]
    assert result.truncated.tolist() == [False, False, True]
    rewards = env.reward_manager.values()
    assert rewards["alive"].tolist() == [float(rewards["always"][0]), 0.0, float(rewards["always"][2])]
    assert (rewards["always"] > 50.0).all()
    assert torch.equal(result.reward, rewards["always"] + rewards["alive"])


def test_causes_name_all_fired_terminations(tmp_path):
    changes = {"terminations": {"also": {"func": "root_height_below_minimum", "minimum_height": 0.2}}}
    env = build(critter(tmp_path, edited(CRITTER_TASK, **changes)), 2)
    env.reset()
    env.engine.field("qpos")[1, 2] = -5.0
    ended = env.step(torch.zeros(2, 4)).episodes
    assert ended.ids.tolist() == [1]
    assert {name for name, fired in ended.causes.items() if fired[0]} >= {"low", "also"}
    assert not ended.causes["time_out"][0]


def test_null_removes_a_term(tmp_path):
    env = build(critter(tmp_path), 2, "rewards.power=null", "observations.policy.action=null", "events.push=null")
    assert "power" not in [t.name for t in env.reward_manager.terms]
    assert env.layout.size() == 18


def test_two_actions_on_one_actuator_are_rejected(tmp_path):
    twice = {"legs": {"func": "joint_position"}, "more": {"func": "joint_position", "joints": ["hip_fl"]}}
    with pytest.raises(RlcliError, match=r"actions.more: the action 'legs' drives 'hip_fl' already"):
        build(critter(tmp_path, edited(CRITTER_TASK, actions=twice, rewards={"power": None})))


def test_power_consumption_rejects_other_joints(tmp_path):
    with pytest.raises(RlcliError, match=r"rewards.power.*2 joints.*4"):
        build(critter(tmp_path, edited(CRITTER_TASK, rewards={
            "power": {"func": "power_consumption", "weight": 1.0, "joints": ["hip_f."]}})))  # fmt: skip
