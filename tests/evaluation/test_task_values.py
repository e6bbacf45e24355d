"""Metrics of a task in evaluations: means over each episode, intervals, and limits on both sides."""

import pytest
import torch
from support.worlds import CRITTER, CRITTER_TASK, edited, write

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.envs.observers import StepObserver
from rlcli.evaluation.evaluate import evaluate
from rlcli.random import derive
from rlcli.registry import find_task
from rlcli.rl.action_functions import zero_policy

pytestmark = pytest.mark.usefixtures("empty_folder")

METER = """
summary: An ant's odometer, in short.
decimation: 1
episode_length_s: 0.1
sim: {dt: 0.01, gravity: [0, 0, 0]}
scene: {num_envs: 4, entities: {robot: {model: model.xml}}}
"""
METER_TASK = """
import torch
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    num_observations = 1
    num_actions = 1

    def post_reset(self):
        self.which = torch.arange(self.num_envs).float()
        self.extras["clock"] = torch.zeros(self.num_envs)
        self.extras["pair"] = torch.zeros(self.num_envs, 2)
        self.extras["everywhere"] = 0.0

    def pre_physics_step(self, actions): ...

    def get_observations(self):
        self.obs_buf[:, 0] = self.progress_buf

    def calculate_metrics(self):
        self.rew_buf[:] = 0.0
        self.extras["clock"].copy_(self.progress_buf)  # 1, 2, ... in the steps of an episode
        self.extras["pair"][:, 0].copy_(self.which)
        self.extras["pair"][:, 1].copy_(3.0 * self.which)
        self.extras["everywhere"] = 7
        self.extras["words"] = "left out"

    def is_done(self):
        self.reset_buf[:] = self.progress_buf >= 5 + self.which  # 5, 6, 7 and 8 steps
"""
MODEL = """
<mujoco><worldbody><body>
  <joint name="slide" type="slide"/><geom size="0.1" mass="1"/>
</body></worldbody></mujoco>
"""
ZERO = ("--policy", "zero", "--num-envs", 4)


@pytest.fixture
def meter(tmp_path):
    folder = tmp_path / "meter"
    folder.mkdir()
    for name, text in (("task.yaml", METER), ("task.py", METER_TASK), ("model.xml", MODEL)):
        (folder / name).write_text(text)
    return "./meter"


def test_values_are_means_over_steps_then_over_episodes(cli, meter):
    values = cli("eval", meter, *ZERO, "--episodes", 8, "--json").json["values"]
    assert sorted(values) == ["clock", "everywhere", "pair"]
    # episodes of n steps have a mean of (n + 1) / 2, and each environment lives two of equal length
    assert values["clock"]["mean"] == pytest.approx((3.0 + 3.5 + 4.0 + 4.5) / 4)
    assert values["clock"]["low"] < values["clock"]["mean"] < values["clock"]["high"]
    assert values["pair"]["mean"] == pytest.approx(2.0 * 1.5)
    assert values["everywhere"] == {"mean": 7.0, "std": 0.0, "low": 7.0, "high": 7.0}


def test_values_include_command_metrics(cli, tmp_path):
    command = {"func": "uniform_velocity", "resampling_time_s": [10.0, 10.0],
               "lin_vel_x": [1.0, 1.0], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [0.0, 0.0]}  # fmt: skip
    write(tmp_path / "critter", edited(CRITTER_TASK, commands={"walk": command}), critter_xml=CRITTER)
    message = cli("eval", "./critter", *ZERO, "--episodes", 4, "--json", "--fail-over", "error_vel_xy=0.1")
    assert message.code == 9, message.err
    assert message.json["values"]["walk/error_vel_xy"]["mean"] > 0.1
    assert message.json["failures"][0].startswith("error_vel_xy is ")
    assert message.json["failures"][0].endswith(", above 0.1")


@pytest.mark.parametrize(
    ("limits", "failed"),
    [
        (("--fail-under", "clock=3.7", "--fail-over", "clock=3.8"), []),
        (("--fail-under", "values.clock=3.7",), []),
        (("--fail-under", "clock=3.8"), ["clock is 3.75, below 3.8"]),
        (("--fail-over", "clock=3.7"), ["clock is 3.75, above 3.7"]),
        (("--fail-over", "length=6", "--fail-over", "return=0"), ["length is 6.5, above 6"]),
        (("--fail-under", "clock.low=3.7"), ["clock.low is "]),
        (("--fail-over", "clock.high=3.8"), ["clock.high is "]),
        (("--fail-over", "terminations.task=0.9"), ["terminations.task is 1, above 0.9"]),
    ],
)  # fmt: skip
def test_value_beyond_its_limit_exits_9(cli, meter, limits, failed):
    done = cli("eval", meter, *ZERO, "--episodes", 8, "--json", *limits)
    assert done.code == (9 if failed else 0), done.err
    assert len(done.json["failures"]) == len(failed)
    assert all(message.startswith(begin) for message, begin in zip(done.json["failures"], failed, strict=True))


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        (("--fail-under", "clok=1"), "the evaluation has no metric 'clok'"),
        (("--fail-under", "clok=1"), "did you mean 'clock'?"),
        (("--fail-over", "clock.low=1"), "the evaluation has no metric 'clock.low'"),
        (("--fail-over", "success.low=1"), "--fail-over 'success.low=1' is not"),
        (("--fail-over", "lenght=1"), "--fail-over 'lenght=1' is not"),
    ],
)
def test_limit_of_an_unknown_value_is_a_usage_error(cli, meter, limit, message):
    done = cli("eval", meter, *ZERO, "--episodes", 4, *limit)
    assert (done.code, message in done.err) == (2, True), done.err


def test_value_that_is_not_finite_is_null(cli, meter, tmp_path):
    file = tmp_path / "meter" / "task.py"
    file.write_text(
        file.read_text().replace('self.extras["everywhere"] = 7', 'self.extras["everywhere"] = float("nan")')
    )
    done = cli("eval", meter, *ZERO, "--episodes", 4, "--json", "--fail-under", "everywhere=1")
    assert done.code == 9
    assert done.json["values"]["everywhere"] == {"mean": None, "std": None, "low": None, "high": None}
    assert "not finite" in cli("eval", meter, *ZERO, "--episodes", 4).out


def test_ant_speed_is_distance_over_time(cli):
    message = cli("eval", "ant-direct", *ZERO, "--episodes", 4, "--json", "episode_length_s=0.5").json
    resolved = resolve(find_task("ant-direct"), play=True, flags={"scene.num_envs": 4, "episode_length_s": 0.5})
    env = make_env(resolved, seed=derive(42, "evaluation"))
    env.reset()
    start = env.task.distance.clone()
    gained = []

    class Speed(StepObserver):
        def on_step(self, record):
            gained.append((start - env.task.distance) / (env.episode_length_buf * env.step_dt))

    env.observers.add(Speed())
    for _ in range(30):
        env.step(torch.zeros(4, 8))
    assert message["length"]["mean"] == 30.0
    assert message["values"]["speed"]["mean"] == pytest.approx(float(gained[-1].mean()), abs=1e-3)


def test_evaluate_restores_the_observers():
    env = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": 2}))
    records = []

    class Records(StepObserver):
        def on_step(self, record):
            records.append(record)

    env.observers.add(Records())
    before = env.observers.on_step
    evaluate(env, zero_policy(env), 2)
    assert env.observers.on_step == before
    assert records, "an observer that was there before is called as well"
