"""Recorder of failure cases: the training is unchanged, cases equal their episodes, and none is written twice."""

import random

import numpy as np
import pytest
import torch
from support.diverging_worlds import FAULTS, pair, step_both
from support.fault_sizes import chosen
from support.run_comparison import content, leftovers, newest, rows_of
from support.small_trainings import AGENTS, Case, resolved_of, train
from support.worlds import CRITTER_TASK, build, critter, edited

from rlcli.config.schema import AutopsyConfig
from rlcli.envs.step_result import Episodes
from rlcli.errors import CheckpointError, MachineError
from rlcli.replay import failure_recorder
from rlcli.replay.episode_recorder import EpisodeRecorder
from rlcli.replay.failure_cases import FOLDER, list_failure_cases, stage_case
from rlcli.replay.failure_recorder import FailureRecorder
from rlcli.replay.resimulate import replay_calls
from rlcli.replay.trajectory import read_trajectory
from rlcli.runs.run import Run
from rlcli.training import loop

KEPT = AutopsyConfig(seconds=0.1, keep=7)
LONGER = {"sac": "train_freq: 6", "td3": "train_freq: 6"}
"""Steps of an iteration; the default of three ends too few episodes."""
GRID = [(Case(task, agent, True, LONGER.get(agent, "")), cut) for agent in AGENTS
        for task in ("everything", "cartpole-direct") for cut in (1, 4, "within")]  # fmt: skip


@pytest.fixture
def low_fences(monkeypatch):
    """Make nearly every return unusual: in a small training most episodes end by time-out."""
    monkeypatch.setattr(failure_recorder, "LEAST", 4)
    monkeypatch.setattr(failure_recorder, "FAR", 0.0)


@pytest.fixture(scope="module")
def base_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tasks")


def names(run):
    return sorted(file.name for file in (run / FOLDER).glob("*.safetensors"))


def cases(run):
    files = [file for file in (run / FOLDER).iterdir() if file.suffix == ".safetensors"]
    found = list_failure_cases(Run(run))
    assert len(found) == len(files), "none is skipped"
    return found


@pytest.mark.parametrize(("case", "cut"), chosen(GRID, 2), ids=str)
def test_recording_failures_does_not_change_the_training(case, cut, base_folder, tmp_path, monkeypatch, low_fences):
    plain = train(tmp_path / "plain", case, base_folder).folder
    kept = train(tmp_path / "kept", case, base_folder, autopsy=KEPT).folder
    assert rows_of(kept) == rows_of(plain)
    assert content(newest(kept)) == content(newest(plain))
    assert 4 <= len(names(kept)) <= KEPT.keep
    assert not (plain / FOLDER).exists()
    if cut == "within":
        monkeypatch.setattr(loop, "LONG_S", -1.0)
        at = random.Random(str(case)).randrange(2, 9), 1
        train(tmp_path / "cut", case, base_folder, within=at, save_interval=None, autopsy=KEPT)
    else:
        train(tmp_path / "cut", case, base_folder, after=cut, autopsy=KEPT)
    resumed = train(tmp_path / "cut", case, base_folder, resume=-1, autopsy=KEPT).folder
    assert content(newest(resumed)) == content(newest(plain))
    assert leftovers(resumed) == []
    assert names(resumed) == names(kept), "the same episodes, none twice"
    for file in names(kept):
        left, right = (read_trajectory(run / FOLDER / file) for run in (kept, resumed))
        assert left.header.failure == right.header.failure
        last = min(d.header.episodes[0].kept for d in (left, right))  # before the cut nothing is recorded
        of_left, of_right = (d.header.episodes[0].model_copy(update={"kept": last}) for d in (left, right))
        assert of_left == of_right
        for name in ("episode.0.rewards", "episode.0.observations", "episode.0.actions", "world.0.states"):
            assert torch.equal(left.tensors[name][-last:], right.tensors[name][-last:])
        assert replay_calls(right, resolved_of(case, base_folder).source).difference is None


def test_resume_from_an_older_checkpoint_removes_newer_cases(base_folder, tmp_path, low_fences):
    case = Case("everything", "ppo", normalize=False)
    run = train(tmp_path / "r", case, base_folder, autopsy=KEPT).folder
    step = 4 * 16
    assert max(found.failure.step for found in cases(run)) > step
    train(run, case, base_folder, resume=step, after=5, autopsy=KEPT)
    assert {found.failure.step for found in cases(run)} <= {*range(step + 1), 5 * 16}


# --- a case equals its episode ---

LYING = edited(CRITTER_TASK, terminations={"low": {"func": "root_height_below_minimum", "minimum_height": 0.28}})
NERVOUS = edited(CRITTER_TASK, terminations={"tilt": {"func": "bad_orientation", "limit_angle": 0.2}})


def recorder_of(env, folder, **config):
    folder.mkdir(exist_ok=True)
    return FailureRecorder(env, AutopsyConfig(**{"seconds": 0.2, "keep": 20, **config}), folder, None)


def random_rollout(env, steps, seed=0, act=None):
    """Step with random actions, and return all recorded values."""
    generator = torch.Generator().manual_seed(seed)
    act = act or (lambda obs: torch.rand(env.num_envs, 4, generator=generator) * 2 - 1)
    with env.observers.added(EpisodeRecorder(env, 10**6)) as recorder:
        obs = env.reset(seed=env.seed)["policy"]
        seen = []
        for _ in range(steps):
            seen.append(obs.clone())
            obs = env.step(act(obs)).obs["policy"]
    return recorder, seen


def test_case_holds_the_last_steps_of_its_episode(tmp_path):
    env = build(critter(tmp_path, NERVOUS), 6)
    kept = recorder_of(env, tmp_path / "run")
    recorder, seen = random_rollout(env, 80)
    kept.commit(1, 480)
    kept.write(kept.take(480))
    found = cases(tmp_path / "run")
    assert found
    by_key = {}
    for number, episode in enumerate(recorder.episodes):
        assert episode.index == sum(other.env == episode.env for other in recorder.episodes[:number])
        by_key[episode.env, episode.index] = episode
    for case in found:
        episode = by_key[case.episode.env, case.episode.index]
        assert (case.episode.length, case.episode.causes) == (episode.length, episode.causes)
        assert case.episode.total_reward == pytest.approx(episode.total_reward, rel=1e-6)
        steps = range(episode.begin + episode.length - case.episode.kept, episode.begin + episode.length)
        assert case.episode.kept == min(episode.length, round(0.2 / env.step_dt))
        parts = {"observations": seen, "actions": recorder._actions, "rewards": recorder._rewards}
        for name, values in parts.items():
            assert np.array_equal(case.values(name), torch.stack([values[t][episode.env] for t in steps]).numpy())
        assert case.values("reward_terms").sum(axis=1) == pytest.approx(case.values("rewards"), rel=1e-4, abs=1e-6)
        staged = stage_case(case, env.resolved.source)
        qpos = staged.staged.worlds[0].world.layout.columns("qpos")
        after = np.stack([state[qpos] for state in staged.states[1:]])
        assert np.array_equal(after, torch.stack([recorder._after[t]["qpos"][case.episode.env] for t in steps]).numpy())
        assert replay_calls(case.trajectory, env.resolved.source).difference is None


def test_contacts_are_those_of_the_last_state(tmp_path):
    env = build(critter(tmp_path, LYING), 6)
    kept = recorder_of(env, tmp_path / "run")
    random_rollout(env, 80, act=lambda obs: torch.zeros(6, 4))
    kept.commit(1, 480)
    kept.write(kept.take(480))
    standing = [stage_case(case, env.resolved.source).contacts() for case in cases(tmp_path / "run")]
    touching = [contacts for contacts in standing if contacts]
    assert touching
    for contacts in touching:
        assert all(contact.force >= 0.0 for contact in contacts)
        assert any("ground" in " ".join(contact.geoms) for contact in contacts)


def returns(kept, values, *, truncated=True, cause="time_out"):
    """End episodes with these returns, without steps."""
    kept._env.episode_index += 1
    for start in range(0, len(values), kept._env.num_envs):
        some = torch.tensor(values[start : start + kept._env.num_envs])
        every = torch.ones(len(some), dtype=torch.bool)
        lengths = torch.full((len(some),), 3)
        kept._choose(Episodes(torch.arange(len(some)), some, lengths, {}, {cause: every}, every & truncated, None))


def test_unusual_return_needs_enough_recent_returns(tmp_path):
    env = build("cartpole", 4)
    kept = recorder_of(env, tmp_path)
    env.reset()
    for _ in range(5):
        env.step(torch.zeros(4, 1))
    spread = np.linspace(9.0, 11.0, 60).tolist()
    returns(kept, [*spread, -50.0])
    kept.commit(1, 1)
    assert not kept._files, "60 returns tell nothing"
    returns(kept, spread)
    kept.commit(2, 2)
    returns(kept, [7.0, 13.0, 10.0, 6.0, -2.0, 30.0])
    kept.commit(3, 3)
    found = {kept.kind: kept.episode.total_reward for kept, _ in kept._unwritten.values()}
    assert found == {"low return": -2.0, "high return": 30.0}, "the farthest of each side"
    for number in range(4, 10):
        returns(kept, [10.0] * 500)
        kept.commit(number, number)
    before = len(kept._files)
    returns(kept, [10.0 - 1e-5])
    kept.commit(10, 10)
    assert len(kept._files) == before, "returns alike to three digits are all the same"


def test_oldest_case_of_the_most_frequent_kind_is_dropped(tmp_path):
    env = build("cartpole", 4)
    kept = recorder_of(env, tmp_path, keep=4)
    env.reset()
    for _ in range(5):
        env.step(torch.zeros(4, 1))
    fell = {"truncated": False, "cause": "cart_out_of_bounds"}
    returns(kept, [10.0] * 100)
    returns(kept, [10.0], **fell)
    kept.commit(1, 1)
    returns(kept, [99.0])
    kept.commit(2, 2)
    for number in range(3, 9):
        returns(kept, [10.0], **fell)
        kept.commit(number, number)
    assert [(kept.kind, failure.step) for kept, failure in kept._unwritten.values()] == [
        ("high return", 2), ("terminated", 6), ("terminated", 7), ("terminated", 8),
    ]  # fmt: skip
    kept.write(kept.take(8))
    assert len(list((tmp_path / FOLDER).glob("*.safetensors"))) == 4
    returns(kept, [10.0], **fell)
    kept.commit(9, 9)
    batch = kept.take(9)
    kept.write(batch)
    kept.drop(batch)
    assert [case.failure.step for case in cases(tmp_path)] == [2, 7, 8, 9]


def test_resume_keeps_cases_that_cannot_be_read(tmp_path):
    env = build("cartpole", 4)
    kept = recorder_of(env, tmp_path)
    env.reset()
    for _ in range(5):
        env.step(torch.zeros(4, 1))
    for number in (1, 2, 3):
        returns(kept, [10.0], truncated=False, cause="cart_out_of_bounds")
        kept.commit(number, number)
    kept.write(kept.take(3))
    first, _, last = sorted((tmp_path / FOLDER).glob("*.safetensors"))
    for file in (first, last):
        file.write_bytes(b"damaged")
    FailureRecorder(env, AutopsyConfig(), tmp_path, 1)
    assert names(tmp_path) == [first.name, last.name]


def test_memory_limit_shortens_cases(tmp_path):
    env = build(critter(tmp_path), 400)
    kept = recorder_of(env, tmp_path / "run", seconds=20.0, memory_mib=6)
    random_rollout(env, 40)
    rings = sum(ring.nbytes for ring in kept._rings.values()) + env.engine.history._ring.nbytes
    assert rings <= 6 << 20
    assert 0.1 < kept.seconds < 0.5
    kept.commit(1, 16_000)
    kept.write(kept.take(16_000))
    assert cases(tmp_path / "run")
    for case in cases(tmp_path / "run"):
        most = round(kept.seconds / env.step_dt)
        assert min(case.episode.length, most // 2) <= case.episode.kept <= min(case.episode.length, most)
        assert replay_calls(case.trajectory, env.resolved.source).difference is None


def test_disk_error_ends_the_recording_but_not_the_training(tmp_path, monkeypatch, caplog):
    env = build("cartpole", 4, "episode_length_s=0.1")
    kept = recorder_of(env, tmp_path)

    def full(file, header, tensors, **_):
        raise MachineError(f"cannot write {file}: No space left on device")

    monkeypatch.setattr(failure_recorder, "write_trajectory", full)
    env.reset()
    env.episode_length_buf[:] = 0
    for _ in range(13):  # into the next episode
        env.step(torch.ones(4, 1))
    returns(kept, [1.0], truncated=False)
    kept.commit(1, 48)
    kept.write(kept.take(48))
    kept.commit(2, 96)
    assert env.observers.on_step == ()
    assert env.observers.on_divergence == ()
    assert len(caplog.messages) == 1
    assert "No space left" in caplog.messages[0]
    kept.commit(3, 144)
    kept.write(kept.take(144))
    assert len(caplog.messages) == 1


@pytest.mark.parametrize("name", ["nan qpos", "nan ctrl", "event writes nan", "reset writes nan"])
def test_diverged_episode_is_recorded_with_its_cause(tmp_path, name):
    fault = FAULTS[name]
    sound, sick = pair(tmp_path, fault)
    kept = recorder_of(sick, tmp_path / "run", seconds=1.0)
    step_both((sound, sick), 4, seed=1)
    fault.strike(sick, [2])
    if name == "reset writes nan":
        sound.episode_length_buf[2] = sound.max_episode_length
    step_both((sound, sick), 1, seed=2)
    fault.cure(sick, [2])
    if fault.written:
        step_both((sound, sick), 1, seed=3)
    step_both((sound, sick), 3, seed=4)
    kept.commit(1, 99)
    kept.write(kept.take(99))
    (case,) = [case for case in cases(tmp_path / "run") if case.failure.kind == "diverged"]
    assert case.episode.env == 2
    assert case.ended_by.startswith(fault.cause)
    assert "diverged" in case.episode.causes
    assert case.world.diverged_at is not None
    assert case.episode.kept == case.episode.length
    replayed = replay_calls(case.trajectory, sick.resolved.source)
    assert replayed.difference is None
    assert replayed.diverged_at[2] == case.world.diverged_at
    if name == "reset writes nan":
        with pytest.raises(CheckpointError, match="has no finite state"):
            stage_case(case, sick.resolved.source)
    else:
        assert np.isfinite(stage_case(case, sick.resolved.source).states).all()
