"""`train --video-every`: videos of the current policy, which neither change nor stop the training."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from rlcli.runs.metric_rows import read_rows
from rlcli.training.job import Job
from rlcli.training.runner import _training_videos
from rlcli.training.signals import StopRequest
from rlcli.viewer.training_video_recorder import TrainingVideos

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("cartpole", "--num-envs", 8, "--logger", "none", "-q", "sim.engine_threads=1", "agent.torch_threads=1")
PICTURE = ("viewer.width=160", "viewer.height=120", "episode_length_s=0.3")
READ = """
import json, sys, imageio.v2 as imageio
reader = imageio.get_reader(sys.argv[1])
frames = [frame.astype(float) for frame in reader]
print(json.dumps([reader.get_meta_data()["fps"], len(frames), min(frame.std() for frame in frames)]))
"""


@pytest.fixture(autouse=True)
def _undisplayed(monkeypatch):
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def run_of(name):
    (run,) = Path("runs").glob(f"*/*-{name}")
    return run


def clips(run):
    return sorted(path.name for path in (run / "videos").glob("*"))


def without_times(run):
    rows = [*read_rows(run / "metrics.jsonl")]
    return [{name: value for name, value in row.items() if not name.startswith("Perf/")} for row in rows]


def test_missing_gl_is_reported_before_run_is_created(cli, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    done = cli("train", *SMALL, "--video-every", 2)
    assert done.code == 10
    assert "MUJOCO_GL=off" in done.err
    assert not Path("runs").exists()


def test_missing_encoder_is_reported_before_run_is_created(cli, monkeypatch):
    import importlib.util as util

    find = util.find_spec
    monkeypatch.setattr(util, "find_spec", lambda name, *more: None if "imageio" in name else find(name, *more))
    done = cli("train", *SMALL, "--video-every", 2)
    assert done.code == 7
    assert '"rlcli[video]"' in done.err
    assert not Path("runs").exists()


def test_training_without_videos_opens_no_renderer(cli, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert cli("train", *SMALL, "--max-iterations", 1, "--video-every", 0).code == 0


def test_only_rank_0_films(tmp_path):
    run = SimpleNamespace(folder=tmp_path, record={"seed": 1})
    for writes in (True, False):
        job = Job(run, None, [], video_every=2, writes=writes)
        assert (_training_videos(job, StopRequest()) is not None) == writes


def test_failed_video_warns_once_and_restores_rng(caplog):
    def make():
        torch.rand(3)
        raise OSError("the driver is gone")

    before = torch.get_rng_state()
    films = TrainingVideos(make, Path("videos"), 2)
    assert [films.record(None, step) for step in (1, 2)] == [None, None]
    assert len(caplog.messages) == 1
    assert "the driver is gone; training continues" in caplog.messages[0]
    assert torch.equal(torch.get_rng_state(), before)
    assert [films.due(iteration) for iteration in (1, 2, 3, 4)] == [False, True, False, True]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "agent"), [("cartpole", "sb3-ppo"), ("cartpole-direct", "ppo")])
def test_videos_do_not_change_training(cli, weights, task, agent):
    words = (task, *SMALL[1:], *PICTURE, "--agent", agent, "--max-iterations", 4)
    assert cli("train", *words, "--name", "plain").code == 0
    assert cli("train", *words, "--name", "filmed", "--video-every", 2).code == 0
    plain, filmed = run_of("plain"), run_of("filmed")
    assert weights(plain) == weights(filmed)
    assert without_times(plain) == without_times(filmed)
    steps = [row["step"] for row in without_times(filmed) if row["iteration"] % 2 == 0]
    assert clips(filmed) == [f"{step:012d}.mp4" for step in steps]
    for name in clips(filmed):
        read = subprocess.run(
            [sys.executable, "-c", READ, str(filmed / "videos" / name)], capture_output=True, text=True, check=True
        )
        fps, frames, spread = json.loads(read.stdout)
        assert fps == pytest.approx(60, rel=1e-2)
        assert 1 <= frames <= 19  # 0.3 s: 18 steps of the one task, 19 of the other
        assert spread > 1


@pytest.mark.slow
def test_resumed_run_keeps_filming_unless_disabled(cli, weights):
    words = (*SMALL, *PICTURE, "--agent", "ppo", "agent.save_interval=1", "--max-iterations", 4)
    assert cli("train", *words, "--name", "plain").code == 0
    assert cli("train", *words, "--name", "filmed", "--video-every", 1).code == 0
    plain, filmed = run_of("plain"), run_of("filmed")
    rows = without_times(filmed)
    for file in (filmed / "videos").glob("*"):
        file.unlink()
    assert cli("train", "--resume", f"{filmed}@step:{rows[1]['step']}", "--max-iterations", 4, "-q").code == 0
    assert clips(filmed) == [f"{row['step']:012d}.mp4" for row in rows[2:]]
    assert weights(plain) == weights(filmed)
    again = ("train", "--resume", filmed, "-q")
    assert cli(*again, "--max-iterations", 5, "--video-every", 0).code == 0
    assert len(clips(filmed)) == 2


@pytest.mark.slow
def test_training_continues_if_video_cannot_be_written(cli):
    assert cli("train", *SMALL, *PICTURE, "--max-iterations", 1, "--name", "a").code == 0
    run = run_of("a")
    (run / "videos").write_text("in the way")
    done = cli("train", "--resume", run, "--max-iterations", 3, "--video-every", 1, "-q")
    assert done.code == 0
    assert done.err.count("warning: no video") == 1
    assert len(without_times(run)) == 3


@pytest.mark.slow
def test_video_is_aborted_when_training_stops(cli, caplog):
    from rlcli.envs.make import make_env
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.runs.recorded_task import resolve_run
    from rlcli.runs.run import open_run

    assert cli("train", *SMALL, *PICTURE, "--max-iterations", 1, "--name", "a").code == 0
    run = open_run(run_of("a"))
    checkpoint = sorted(run.checkpoints.glob("0*"))[-1]
    env = make_env(resolve_run(run, play=True, flags={"scene.num_envs": 1}))
    policy = open_checkpoint(checkpoint).policy()
    films = TrainingVideos(lambda: env, run.folder / "videos", 1, lambda: int(env.episode_length_buf[0]) > 2)
    caplog.clear()  # records of the training
    assert films.record(lambda: policy, 1) is None
    assert (caplog.messages, clips(run_of("a"))) == ([], [])
    env.close()
