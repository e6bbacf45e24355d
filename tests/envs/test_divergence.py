"""A diverged simulation ends only the episode of its own environment."""

import math

import pytest
import torch
from support.worlds import PENDULUM, PENDULUM_TASK, build, clone, critter, edited, pendulum, results_of_env, same, write

from rlcli.errors import DivergedError

N = 5
QUIET = ("episode_length_s=9.0",)


def poison(env, what, i):
    field = env.engine.field
    if what in ("nan qpos", "inf qpos", "1e12 qpos"):
        field("qpos")[i, 0] = float(what.split()[0])
    elif what in ("nan qvel", "inf qvel", "1e12 qvel"):
        field("qvel")[i, -1] = float(what.split()[0])
    elif what == "1e9 xfrc":
        field("xfrc_applied")[i, 1] = 1e19
    elif what == "nan xfrc":
        field("xfrc_applied")[i, 1, 0] = math.nan
    elif what == "nan mass":
        env.engine.expand("body_mass")[i, 1] = math.nan
    elif what == "nan timestep":
        env.engine.expand("opt.timestep")[i] = math.nan


def cure(env, what, i):
    if what == "nan mass":
        env.engine.expand("body_mass")[i] = torch.from_numpy(env.engine.model.body_mass)
    elif what == "nan timestep":
        env.engine.expand("opt.timestep")[i] = env.engine.model.opt.timestep


POISONS = ["nan qpos", "inf qpos", "1e12 qpos", "nan qvel", "inf qvel", "1e12 qvel", "1e9 xfrc", "nan xfrc", "nan mass",
           "nan timestep"]  # fmt: skip


@pytest.mark.parametrize("number", [0, 2, N - 1])
@pytest.mark.parametrize("what", POISONS)
def test_divergence_terminates_only_its_env(tmp_path, what, number):
    task = critter(tmp_path)
    # with a mass of nan no acceleration is finite in any state: a term that reads one raises its own error
    changes = (*QUIET, "rewards.acc=null") if what == "nan mass" else QUIET
    sound, sick = build(task, N, *changes), build(task, N, *changes)
    if what in ("nan mass", "nan timestep"):  # an expanded model takes another path through the engine
        for env in (sound, sick):
            env.engine.expand("body_mass" if what == "nan mass" else "opt.timestep")
    action = torch.full((N, 4), 0.2)
    for env in (sound, sick):
        env.reset()
        for _ in range(3):
            env.step(action)
    last_finite = sick.sim.qpos[number].clone(), sick.sim.qvel[number].clone()
    poison(sick, what, number)
    expected, found = clone(sound.step(action)), clone(sick.step(action))
    assert found.terminated.tolist() == [i == number for i in range(N)]
    assert not found.truncated.any()
    assert found.episodes.ids.tolist() == [number]
    assert found.episodes.causes["diverged"].tolist() == [True]
    assert sick.divergences == 1
    assert torch.equal(found.final_obs["critic"][number], torch.cat([last_finite[0][7:], last_finite[1][6:]]))
    rest = [i for i in range(N) if i != number]
    cure(sick, what, number)
    results = [(expected, found)]
    results += [(clone(sound.step(action)), clone(sick.step(action))) for _ in range(15)]
    for i in rest:
        assert same(results_of_env([r[1] for r in results], i), results_of_env([r[0] for r in results], i)), (
            f"environment {i} was touched"
        )
    assert all(r[1].obs["policy"].isfinite().all() for r in results)
    assert sick.engine.state_dict()["state"].isfinite().all()
    assert sick.divergences == 1


TERMS = '''
from rlcli.task import Entity


def angle(env, *, entity: Entity = "robot"):
    """(num_envs,)"""
    return entity.data.joint_pos[:, 0]


def broken(env, *, entity: Entity = "robot"):
    """(num_envs,)"""
    return 1.0 / (entity.data.joint_pos[:, 0] - 1.0).round()


def broken_row(env, *, entity: Entity = "robot"):
    """(num_envs, 1)"""
    return 1.0 / (entity.data.joint_pos - 1.0).round()
'''


def rewarded(tmp_path, **changes):
    base = {"reward_dt_scaling": False, "sim": {"gravity": [0.0, 0.0, 0.0]}, "episode_length_s": 5.0,
            "rewards": {"angle": {"func": "angle", "weight": 100.0}}}  # fmt: skip
    return pendulum(tmp_path, edited(PENDULUM_TASK, **{**base, **changes}), terms_py=TERMS)


@pytest.mark.parametrize("what", ["nan qpos", "nan qvel", "nan timestep"])
def test_diverged_env_gets_reward_of_last_finite_state(tmp_path, what):
    env = build(rewarded(tmp_path))
    env.reset()
    env.engine.field("qpos")[1, 0] = 0.5
    env.sim.refresh()
    assert float(env.step(torch.zeros(3, 1)).reward[1]) == pytest.approx(1.0 + 50.0)
    poison(env, what, 1)
    result = env.step(torch.zeros(3, 1))
    assert float(result.reward[1]) == pytest.approx(0.0 - 10.0 + 50.0)
    assert result.episodes.returns.tolist() == pytest.approx([51.0 + 40.0])


def test_divergence_reward_replaces_reward_and_counts_in_return(tmp_path):
    env = build(rewarded(tmp_path, divergence_reward=-7.0))
    env.reset()
    env.engine.field("qpos")[:, 0] = 0.5
    env.step(torch.zeros(3, 1))
    poison(env, "nan qvel", 2)
    result = env.step(torch.zeros(3, 1))
    assert result.reward.tolist() == pytest.approx([51.0, 51.0, -7.0])
    assert result.episodes.returns.tolist() == pytest.approx([51.0 - 7.0])
    terms = {name: float(value[0]) for name, value in result.episodes.reward_terms.items()}
    assert terms == pytest.approx({"alive": 1.0, "terminating": 0.0, "angle": 50.0, "diverged": -7.0})


def test_divergence_reward_applies_to_direct_task(tmp_path):
    env = build("cartpole-direct", 3, "divergence_reward=-3.0")
    env.reset()
    poison(env, "nan qpos", 1)
    result = env.step(torch.zeros(3, 1))
    assert result.terminated.tolist() == [False, True, False]
    assert float(result.reward[1]) == -3.0
    assert result.obs["policy"].isfinite().all()


def test_second_divergence_of_same_env_is_found(tmp_path):
    env = build(critter(tmp_path), 3, *QUIET)
    env.reset()
    for count in (1, 2, 3):
        poison(env, "nan qvel", 1)
        assert env.step(torch.zeros(3, 4)).terminated.tolist() == [False, True, False]
        assert env.divergences == count
        assert not env.step(torch.zeros(3, 4)).terminated.any()


def test_two_simultaneous_divergences_are_found(tmp_path):
    env = build(critter(tmp_path), 4, *QUIET)
    env.reset()
    poison(env, "nan qpos", 0)
    poison(env, "nan timestep", 3)
    assert env.step(torch.zeros(4, 4)).terminated.tolist() == [True, False, False, True]


def test_nan_controls_are_a_divergence(tmp_path):
    terms = '''
import torch
from rlcli.task import Entity


class Poisoned:
    """Action term that writes the action to the controls."""

    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self.size, self.elements, self.unit = 1, ("swing",), ""
        self._ctrl = entity.engine.field("ctrl")

    def process(self, action: torch.Tensor) -> None:
        self._ctrl[:] = torch.where(action > 0.5, torch.nan, 0.0)
'''
    xml = PENDULUM.replace("</mujoco>", '<actuator><motor joint="swing"/></actuator></mujoco>')
    yaml = edited(PENDULUM_TASK, actions={"torque": {"func": "poisoned"}})
    env = build(write(tmp_path / "p", yaml, pendulum_xml=xml, terms_py=terms))
    env.reset()
    result = env.step(torch.tensor([[0.0], [1.0], [0.0]]))
    assert result.terminated.tolist() == [False, True, False]
    assert not env.step(torch.zeros(3, 1)).terminated.any()


def test_nonfinite_action_error_names_policy_and_env(tmp_path):
    env = build(critter(tmp_path), 3)
    env.reset()
    before = env.engine.state_dict()["state"]
    with pytest.raises(DivergedError, match=r"the policy's action is not finite in 1 of 3 .* first in environment 2"):
        env.step(torch.tensor([[0.0] * 4, [0.0] * 4, [0.0, math.nan, 0.0, 0.0]]))
    assert torch.equal(before, env.engine.state_dict()["state"]), "nothing moved"


def test_nonfinite_reward_error_names_term_and_env(tmp_path):
    env = build(rewarded(tmp_path, rewards={"bad": {"func": "broken", "weight": 1.0}}))
    env.reset()
    env.engine.field("qpos")[1:, 0] = 1.0
    with pytest.raises(DivergedError, match=r"reward term 'bad' \(broken\) is not finite in 2 .*environment 1"):
        env.step(torch.zeros(3, 1))


def test_nonfinite_observation_error_names_term_and_env(tmp_path):
    env = build(
        rewarded(tmp_path, observations={"policy": {"pos": {"func": "joint_pos"}, "odd": {"func": "broken_row"}}})
    )
    env.reset()
    env.engine.field("qpos")[2, 0] = 1.0
    with pytest.raises(DivergedError, match=r"observation 'policy.odd' \(broken_row\) .*environment 2"):
        env.step(torch.zeros(3, 1))


def test_mujoco_writes_no_log_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = build(critter(tmp_path), 2)
    env.reset()
    for what in ("nan qpos", "1e9 xfrc"):
        poison(env, what, 0)
        env.step(torch.zeros(2, 4))
    assert env.divergences == 2
    assert [p.name for p in tmp_path.iterdir()] == ["critter"]
