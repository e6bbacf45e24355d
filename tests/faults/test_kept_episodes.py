"""What training keeps of episodes: it notices nothing of that, what is kept is what was lived, and nothing is twice."""

import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from diverging_worlds import FAULTS, lives, pair
from fault_sizes import chosen
from run_comparison import content, leftovers, newest, rows_of
from small_trainings import AGENTS, Case, resolved_of, train
from worlds import CRITTER_TASK, build, critter, edited

from rlcli.config.schema import AutopsyConfig
from rlcli.errors import CheckpointError, MachineError
from rlcli.rl import autopsy
from rlcli.rl import train as loop
from rlcli.rl.autopsy import FOLDER, Keeper
from rlcli.rl.cases import list_cases, restage
from rlcli.rl.dump import read_dump, replay_dump
from rlcli.rl.recording import Recorder
from rlcli.rl.run import Run

KEPT = AutopsyConfig(seconds=0.1, keep=7)
LONGER = {"sac": "train_freq: 6", "td3": "train_freq: 6"}
"""Their own three steps an iteration end too few episodes."""
GRID = [(Case(task, agent, True, LONGER.get(agent, "")), cut) for agent in AGENTS
        for task in ("everything", "cartpole-direct") for cut in (1, 4, "within")]  # fmt: skip


@pytest.fixture
def picky(monkeypatch):
    """Nearly every return is unusual: few episodes of a small training end otherwise than by time."""
    monkeypatch.setattr(autopsy, "LEAST", 4)
    monkeypatch.setattr(autopsy, "FAR", 0.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("tasks")


def names(run):
    return sorted(file.name for file in (run / FOLDER).glob("*.safetensors"))


def cases(run):
    said = []
    found = list_cases(Run(run), said.append)
    assert said == []
    return found


@pytest.mark.parametrize(("case", "cut"), chosen(GRID, 2), ids=str)
def test_a_training_that_keeps_episodes_is_the_one_that_does_not_also_when_cut_and_resumed(
    case, cut, place, tmp_path, monkeypatch, picky
):
    plain = train(tmp_path / "plain", case, place).folder
    kept = train(tmp_path / "kept", case, place, autopsy=KEPT).folder
    assert rows_of(kept) == rows_of(plain)
    assert content(newest(kept)) == content(newest(plain))
    assert 4 <= len(names(kept)) <= KEPT.keep
    assert not (plain / FOLDER).exists()
    if cut == "within":
        monkeypatch.setattr(loop, "LONG_S", -1.0)
        at = random.Random(str(case)).randrange(2, 9), 1
        train(tmp_path / "cut", case, place, within=at, save_interval=None, autopsy=KEPT)
    else:
        train(tmp_path / "cut", case, place, after=cut, autopsy=KEPT)
    resumed = train(tmp_path / "cut", case, place, resume=-1, autopsy=KEPT).folder
    assert content(newest(resumed)) == content(newest(plain))
    assert leftovers(resumed) == []
    assert names(resumed) == names(kept), "the same episodes, none twice"
    for file in names(kept):
        left, right = (read_dump(run / FOLDER / file) for run in (kept, resumed))
        assert left.document.ending == right.document.ending
        last = min(len(d.tensors["0.reward"]) for d in (left, right))  # before the cut nothing is remembered
        for name in ("0.reward", "0.obs", "0.action", "0.state"):
            assert torch.equal(left.tensors[name][-last:], right.tensors[name][-last:])
        assert replay_dump(right, resolved_of(case, place).source).difference is None


def test_an_older_checkpoint_takes_back_what_was_kept_after_it(place, tmp_path, picky):
    case = Case("everything", "ppo", normalize=False)
    run = train(tmp_path / "r", case, place, autopsy=KEPT).folder
    step = 4 * 16
    assert max(found.ending.step for found in cases(run)) > step
    train(run, case, place, resume=step, after=5, autopsy=KEPT)
    assert {found.ending.step for found in cases(run)} <= {*range(step + 1), 5 * 16}


# --- what is kept is what was lived ---

LYING = edited(CRITTER_TASK, terminations={"low": {"func": "root_height_below_minimum", "minimum_height": 0.28}})
NERVOUS = edited(CRITTER_TASK, terminations={"tilt": {"func": "bad_orientation", "limit_angle": 0.2}})


def keeper(env, folder, **config):
    said = []
    return Keeper(env, AutopsyConfig(**{"seconds": 0.2, "keep": 20, **config}), folder, None, said.append), said


def lived(env, steps, seed=0, act=None):
    """Random actions, and everything that happened."""
    generator = torch.Generator().manual_seed(seed)
    with Recorder(
        env, act or (lambda obs: torch.rand(env.num_envs, 4, generator=generator) * 2 - 1), 10**6
    ) as recorder:
        obs = env.reset(seed=env.seed)["policy"]
        seen = []
        for _ in range(steps):
            seen.append(obs.clone())
            step = env.step(recorder.act(obs))
            recorder.on_step(step)
            obs = step.obs["policy"]
    return recorder, seen


def test_a_case_holds_the_end_of_the_episode_as_it_was_lived(tmp_path):
    env = build(critter(tmp_path, NERVOUS), 6)
    kept, said = keeper(env, tmp_path / "run")
    recorder, seen = lived(env, 80)
    kept.commit(1, 480)
    kept.write(kept.take(480))
    assert said == []
    found = cases(tmp_path / "run")
    assert found
    by_key = {}
    for number, episode in enumerate(recorder.episodes):
        index = sum(other.env == episode.env for other in recorder.episodes[:number])
        by_key[episode.env, index] = episode
    for case in found:
        episode = by_key[case.env, case.ending.episode]
        assert (case.ending.length, case.ending.causes) == (episode.length, episode.causes)
        assert case.ending.total_reward == pytest.approx(episode.total_reward, rel=1e-6)
        steps = range(episode.begin + episode.length - case.steps, episode.begin + episode.length)
        assert case.steps == min(episode.length, round(0.2 / env.step_dt))
        assert np.array_equal(case.observations, torch.stack([seen[t][case.env] for t in steps]).numpy())
        assert np.array_equal(case.actions, torch.stack([recorder._actions[t][case.env] for t in steps]).numpy())
        assert np.array_equal(case.reward, torch.stack([recorder._rewards[t][case.env] for t in steps]).numpy())
        assert case.reward_terms.sum(axis=1) == pytest.approx(case.reward, rel=1e-4, abs=1e-6)
        scene = restage(case, env.resolved.source)
        qpos = scene.world.state_layout.columns("qpos")
        after = np.stack([state[qpos] for state in scene.states[1:]])
        assert np.array_equal(after, torch.stack([recorder._after[t]["qpos"][case.env] for t in steps]).numpy())
        assert replay_dump(case.dump, env.resolved.source).difference is None


def test_contacts_at_the_end_are_those_of_the_last_state(tmp_path):
    env = build(critter(tmp_path, LYING), 6)
    kept, _ = keeper(env, tmp_path / "run")
    lived(env, 80, act=lambda obs: torch.zeros(6, 4))
    kept.commit(1, 480)
    kept.write(kept.take(480))
    standing = [restage(case, env.resolved.source).contacts() for case in cases(tmp_path / "run")]
    touching = [contacts for contacts in standing if contacts]
    assert touching
    for contacts in touching:
        assert all(contact.force >= 0.0 for contact in contacts)
        assert any("ground" in " ".join(contact.geoms) for contact in contacts)


def returns(kept, values, **more):
    """Tell a keeper of episodes with such returns, without living them."""
    ended = autopsy._Ended(
        kept._step,
        kept._engine.history.count,
        np.arange(len(values)) % kept._env.num_envs,
        np.arange(len(values)),
        np.full(len(values), 3),
        np.array(values, np.float32),
        np.ones(len(values), bool),
        {"time_out": np.ones(len(values), bool)},
        kept._engine.rows(np.arange(len(values)) % kept._env.num_envs),
        {},
    )
    kept._ended.append(replace(ended, **more))


def test_a_return_beyond_the_fences_of_the_recent_ones_is_unusual_and_only_with_enough_of_them(tmp_path):
    env = build("cartpole", 4)
    kept, _ = keeper(env, tmp_path)
    env.reset()
    for _ in range(5):
        env.step(torch.zeros(4, 1))
    spread = np.linspace(9.0, 11.0, 60).tolist()
    returns(kept, [*spread, -50.0])
    kept.commit(1, 1)
    assert kept._entries == [], "60 returns tell nothing"
    returns(kept, spread)
    kept.commit(2, 2)
    returns(kept, [7.0, 13.0, 10.0, 6.0, -2.0, 30.0])
    kept.commit(3, 3)
    found = {entry.kind: entry.ending.total_reward for entry in kept._entries}
    assert found == {"low return": -2.0, "high return": 30.0}, "the farthest of each side"
    for number in range(4, 10):
        returns(kept, [10.0] * 500)
        kept.commit(number, number)
    before = len(kept._entries)
    returns(kept, [10.0 - 1e-5])
    kept.commit(10, 10)
    assert len(kept._entries) == before, "returns alike to three digits are all the same"


def test_of_what_does_not_fit_the_oldest_of_the_commonest_kind_goes(tmp_path):
    env = build("cartpole", 4)
    kept, _ = keeper(env, tmp_path, keep=4)
    env.reset()
    for _ in range(5):
        env.step(torch.zeros(4, 1))
    fell = {"truncated": np.zeros(1, bool), "causes": {"cart_out_of_bounds": np.ones(1, bool)}}
    returns(kept, [10.0] * 100)
    returns(kept, [10.0], **fell)
    kept.commit(1, 1)
    returns(kept, [99.0])
    kept.commit(2, 2)
    for number in range(3, 9):
        returns(kept, [10.0], **fell)
        kept.commit(number, number)
    assert [(entry.kind, entry.ending.step) for entry in kept._entries] == [
        ("high return", 2), ("terminated", 6), ("terminated", 7), ("terminated", 8),
    ]  # fmt: skip
    kept.write(kept.take(8))
    assert len(list((tmp_path / FOLDER).glob("*.safetensors"))) == 4
    returns(kept, [10.0], **fell)
    kept.commit(9, 9)
    batch = kept.take(9)
    kept.write(batch)
    kept.drop(batch)
    assert [case.ending.step for case in cases(tmp_path)] == [2, 7, 8, 9]


def test_where_memory_is_short_fewer_seconds_are_kept_and_still_exactly(tmp_path):
    env = build(critter(tmp_path), 400)
    kept, _ = keeper(env, tmp_path / "run", seconds=20.0, memory_mib=6)
    lived(env, 40)
    rings = sum(ring.nbytes for ring in kept._rings.values()) + env.engine.history._ring.nbytes
    assert rings <= 6 << 20
    assert 0.1 < kept.seconds < 0.5
    kept.commit(1, 16_000)
    kept.write(kept.take(16_000))
    assert cases(tmp_path / "run")
    for case in cases(tmp_path / "run"):
        most = round(kept.seconds / env.step_dt)
        assert min(case.ending.length, most // 2) <= case.steps <= min(case.ending.length, most)
        assert replay_dump(case.dump, env.resolved.source).difference is None


def test_a_disk_that_refuses_ends_the_keeping_and_not_the_training(tmp_path, monkeypatch):
    env = build("cartpole", 4, "episode_length_s=0.1")
    kept, said = keeper(env, tmp_path)

    def full(file, content):
        raise MachineError(f"cannot write {file}: No space left on device")

    monkeypatch.setattr(autopsy, "put", full)
    env.reset()
    env.episode_length_buf[:] = 0
    for _ in range(12):
        env.step(torch.ones(4, 1))
    returns(kept, [1.0], truncated=np.zeros(1, bool))
    kept.commit(1, 48)
    kept.write(kept.take(48))
    kept.commit(2, 96)
    assert env.on_lived is None
    assert env.on_divergence == []
    assert len(said) == 1
    assert "No space left" in said[0]
    kept.commit(3, 144)
    kept.write(kept.take(144))
    assert len(said) == 1


@pytest.mark.parametrize("name", ["nan qpos", "nan ctrl", "event writes nan", "reset writes nan"])
def test_an_episode_that_diverged_is_kept_with_where_it_went_wrong(tmp_path, name):
    fault = FAULTS[name]
    sound, sick = pair(tmp_path, fault)
    kept, _ = keeper(sick, tmp_path / "run", seconds=1.0)
    lives((sound, sick), 4, seed=1)
    fault.strike(sick, [2])
    if name == "reset writes nan":
        sound.episode_length_buf[2] = sound.max_episode_length
    lives((sound, sick), 1, seed=2)
    fault.cure(sick, [2])
    if fault.written:
        lives((sound, sick), 1, seed=3)
    lives((sound, sick), 3, seed=4)
    kept.commit(1, 99)
    kept.write(kept.take(99))
    (case,) = [case for case in cases(tmp_path / "run") if case.ending.kind == "diverged"]
    assert case.env == 2
    assert case.ended_by.startswith(fault.cause)
    assert "diverged" in case.ending.causes
    assert case.dump.document.lives[0].where is not None
    assert case.steps == case.ending.length
    replayed = replay_dump(case.dump, sick.resolved.source)
    assert replayed.difference is None
    assert replayed.where[2] == case.dump.document.lives[0].where
    if name == "reset writes nan":
        with pytest.raises(CheckpointError, match="no state that is finite"):
            restage(case, sick.resolved.source)
    else:
        assert np.isfinite(restage(case, sick.resolved.source).states).all()
