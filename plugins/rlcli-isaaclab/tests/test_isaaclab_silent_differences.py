"""Settings and values of Isaac Lab's tasks that must have an effect or a message: logged extras, gravity, markers."""

import logging

import pytest
import torch
from test_isaaclab_user_code import rover
from test_unchanged_isaaclab_files import DIRECT

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.evaluation.evaluate import evaluate
from rlcli.registry import find_task
from rlcli_isaaclab.absent import report_once

torch.set_num_threads(1)
RESET = "        super()._reset_idx(env_ids)\n"


@pytest.fixture
def pole(tmp_path):
    """Return a function that writes the direct task with replaced parts of its text, and resolves it."""
    report_once.cache_clear()

    def make(*changes):
        text = DIRECT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "pole").mkdir(exist_ok=True)
        (tmp_path / "pole/pole_env.py").write_text(text)
        (tmp_path / "pole/models.yaml").write_text("pole.usd: cartpole:cartpole.xml\n")
        return resolve(find_task(f"{tmp_path / 'pole/pole_env.py'}:PoleEnvCfg"))

    return make


LOG = RESET + (
    '        self.extras["log"] = dict()\n'
    "        steps = self.episode_length_buf[env_ids].float().mean()\n"
    '        self.extras["log"].update({"Metrics/steps": steps, "ended": 1})\n'
)


def run(env, steps):
    env.reset()
    for _ in range(steps):
        env.step(torch.ones(env.num_envs, 1))


def test_values_that_a_direct_task_logs_in_a_reset_are_metrics(pole):
    env = make_env(pole((RESET, LOG)), seed=0)
    run(env, 8)
    assert env.extras()["Metrics/steps"] == 0.0  # of the first reset
    run(env, 8)
    env.extras()
    for _ in range(2):
        env.step(torch.ones(4, 1))
    found = env.extras()
    assert found["Metrics/steps"] > 0.0
    assert found["Episode/ended"] == 1.0  # the name that RSL-RL gives a value without a group


def test_evaluation_reports_the_values_that_the_reset_after_each_episode_logs(pole):
    env = make_env(pole((RESET, LOG)), seed=0)
    result = evaluate(env, lambda obs: torch.ones(len(obs), 1), 8)
    assert result.values["Metrics/steps"] == [float(length) for length in result.lengths]


def test_values_that_a_direct_task_logs_in_a_step_are_means_over_steps(pole):
    line = '        self.extras["log"] = {"Step/number": self.observed.clone()}\n        velocity ='
    env = make_env(pole(("        velocity =", line)), seed=0)
    result = evaluate(env, lambda obs: torch.ones(len(obs), 1), 4)
    assert result.values["Step/number"] == [pytest.approx(5.0)] * 4  # 1 to 9
    env.extras()
    env.step(torch.ones(4, 1))
    assert env.extras()["Step/number"] > 5.0


def test_other_extras_are_reported_once(pole, caplog):
    line = (
        '        self.extras["plain"] = torch.zeros(2)\n'
        '        self.extras["log"] = {"text": "a", "Train/mean_reward": 5.0}\n        velocity ='
    )
    env = make_env(pole(("        velocity =", line)), seed=0)
    with caplog.at_level(logging.WARNING):
        run(env, 3)
    messages = [record.getMessage() for record in caplog.records]
    assert "env.extras['plain'] is ignored: only the numbers in env.extras['log'] are logged" in messages
    assert "env.extras['log']['Episode/text'] is ignored: expected a number or a tensor, found a str" in messages
    assert "env.extras['log']['Train/mean_reward'] is ignored: rlcli computes a metric of this name" in messages
    assert len(messages) == len(set(messages)) == 3


def test_values_that_terms_of_a_manager_based_task_log_are_metrics(tmp_path):
    code = """
def logged(env):
    env.extras["log"]["Metrics/two"] = 2.0
    return torch.ones(env.num_envs)

def at_reset(env, env_ids):
    env.extras["log"].update({"Metrics/ended": float(len(env_ids))})
"""
    terms = {"rewards": {"own": "RewardTermCfg(func=logged, weight=1.0)"}}
    terms["events"] = {"note": "EventTermCfg(func=at_reset, mode='reset')"}
    env = make_env(rover(tmp_path / "rover", code, **terms), seed=0)
    env.reset()
    env.step(torch.zeros(env.num_envs, env.layout.action_size))
    found = env.extras()
    assert (found["Metrics/two"], found["Metrics/ended"]) == (2.0, 4.0)
    result = evaluate(env, lambda obs: torch.zeros(len(obs), env.layout.action_size), 4)
    assert result.values["Metrics/two"] == [2.0] * 4
    assert result.values["Metrics/ended"] == [4.0] * 4


PROPERTIES = (
    'usd_path="omniverse://somewhere/pole.usd", rigid_props=sim_utils.RigidBodyPropertiesCfg('
    "disable_gravity=True, linear_damping=0.0, angular_damping=0.5, max_linear_velocity=9.0), "
    "articulation_props=sim_utils.ArticulationRootPropertiesCfg(fix_root_link=True, enabled_self_collisions=False)"
)


def test_disable_gravity_of_a_direct_task_acts_and_other_properties_are_reported_by_key(pole):
    resolved = pole(('usd_path="omniverse://somewhere/pole.usd"', PROPERTIES), ("dt=0.01", "dt=0.01, use_fabric=True"))
    assert not resolved.task.scene.entities["robot"].gravity
    env = make_env(resolved, seed=0)
    assert env.engine.model.body_gravcomp.tolist()[1:] == [1.0] * (env.engine.model.nbody - 1)
    notes = {note.key: note.text for note in resolved.notes if note.status == "ignored"}
    start = "scene.robot.spawn"
    assert {key for key in notes if "_props" in key} == {
        f"{start}.rigid_props.angular_damping",
        f"{start}.rigid_props.max_linear_velocity",
        f"{start}.articulation_props.enabled_self_collisions",
    }
    assert all(notes.values())


def test_disable_gravity_of_a_manager_based_task_acts(tmp_path):
    spawn = 'usd_path="omniverse://somewhere/rover.usd"'
    lifted = spawn + ", rigid_props=sim_utils.RigidBodyPropertiesCfg(disable_gravity=True)"
    env = make_env(rover(tmp_path / "rover", "", [(spawn, lifted)]), seed=0)
    model = env.engine.model
    bodies = [b for b in range(model.nbody) if model.body(b).name.startswith("robot/")]
    assert model.body_gravcomp[bodies].tolist() == [1.0] * 3


def test_settings_of_a_direct_task_without_an_effect_are_reported(pole):
    scale = 'usd_path="omniverse://somewhere/pole.usd", scale=(2.0, 2.0, 2.0)'
    seed = ("    force = 5.0\n", "    force = 5.0\n    seed = 7\n    is_finite_horizon = True\n")
    resolved = pole(('usd_path="omniverse://somewhere/pole.usd"', scale), seed)
    ignored = {note.key for note in resolved.notes if note.status == "ignored"}
    assert {"scene.robot.spawn.scale", "seed", "is_finite_horizon"} <= ignored
