"""Direct tasks that draw in the middle of an episode, and that compute a metric of an episode."""

import pytest
import torch
from support.worlds import ENGINES, PENDULUM, build, clone, results_of_env, same, write

CODE = '''
import torch
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    """Draws a goal at the start; environments of odd number draw again in every third step of an episode."""

    num_observations = 3
    num_actions = 1

    def post_reset(self):
        n = self.num_envs
        self.goal, self.other, self.count = (torch.zeros(n, device=self.device) for _ in range(3))
        self.odd = torch.arange(n, device=self.device) % 2 == 1
        self.episode_metrics["drawn"] = self.count

    def reset(self, selection):
        selection.write(self.goal, selection.uniform(0.0, 1.0))
        selection.write(self.count, 0.0)

    def pre_physics_step(self, actions):
        pass

    def get_observations(self):
        torch.stack([self.goal, self.other, self.progress_buf.float()], dim=1, out=self.obs_buf)

    def calculate_metrics(self):
        due = self.odd & (self.progress_buf % 3 == 0)
        self.count.add_(due)
        selection = self.selection(due, "goal")
        if selection is not None:
            selection.write(self.goal, selection.uniform(0.0, 1.0))
        selection = self.selection(due, "other")
        if selection is not None:
            selection.write(self.other, selection.uniform(0.0, 1.0))
        self.rew_buf.copy_(self.goal)

    def is_done(self):
        pass
'''
TASK = """
decimation: 2
episode_length_s: 0.2
sim: {dt: 0.01}
scene: {num_envs: 4, ground: null, entities: {robot: {model: pendulum.xml}}}
"""


@pytest.fixture
def task(tmp_path):
    return write(tmp_path / "goals", TASK, pendulum_xml=PENDULUM, task_py=CODE)


def rollout(task, num_envs, steps=25, *overrides, seed=3):
    env = build(task, num_envs, *overrides, seed=seed)
    env.reset()
    return env, [clone(env.step(torch.zeros(num_envs, 1))) for _ in range(steps)]


def goals(results, env):
    return [float(result.obs["policy"][env, 0]) for result in results]


def test_selection_draws_for_selected_envs_in_each_step(task):
    _, results = rollout(task, 4)
    even, odd = goals(results, 0), goals(results, 1)
    assert len(set(even[:9])) == 1, "one episode, one goal"
    # draws of steps 3 and 6 are observed one step later; step 10 begins a new episode
    assert [odd[i] != odd[i + 1] for i in range(9)] == [False, False, True, False, False, True, False, False, True]


def test_draws_differ_by_name_env_and_episode(task):
    env, results = rollout(task, 4)
    drawn = {value for row in (1, 3) for value in goals(results, row)}
    assert len(drawn) == 2 * (3 + 3 + 2), "each environment sees three goals an episode, and two of the third"
    assert not torch.equal(env.task.goal[env.task.odd], env.task.other[env.task.odd])


def test_draws_independent_of_other_envs(task):
    few, many = rollout(task, 2)[1], rollout(task, 7)[1]
    assert goals(few, 1) == goals(many, 1)
    assert goals(rollout(task, 2, seed=4)[1], 1) != goals(few, 1)


def test_repeated_episode_draws_the_same(task):
    env, results = rollout(task, 2, 20)
    env.reset(seed=3, episode=1)
    again = [clone(env.step(torch.zeros(2, 1))) for _ in range(9)]
    assert goals(again, 1) == goals(results[10:], 1)[:9]


@pytest.mark.warp
def test_gpu_and_cpu_draw_the_same(task):
    host, device = (rollout(task, 5, 25, f"sim.engine={engine}")[1] for engine in ("batch", "warp"))
    for row in range(5):
        torch.testing.assert_close(goals(host, row), goals(device, row), atol=1e-6, rtol=0)


def test_state_dict_restores_draws(task):
    env, _ = rollout(task, 3, 4)
    saved = env.state_dict()
    expected = [clone(env.step(torch.zeros(3, 1))) for _ in range(20)]
    fresh = build(task, 3, seed=8)
    fresh.load_state_dict(saved)
    found = [clone(fresh.step(torch.zeros(3, 1))) for _ in range(20)]
    assert all(same(results_of_env(expected, row), results_of_env(found, row)) for row in range(3))


@pytest.mark.parametrize("engine", ENGINES)
def test_episode_metrics_are_values_of_last_step(task, engine):
    env, results = rollout(task, 4, 10, f"sim.engine={engine}")
    ended = results[-1].episodes.ended()
    assert ended.ids.tolist() == [0, 1, 2, 3]
    assert ended.metrics["drawn"].tolist() == [0.0, 3.0, 0.0, 3.0]
    assert not env.task.count.any()
