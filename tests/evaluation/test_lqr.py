"""The linear-quadratic regulator: equations solved by hand, the cartpoles, and tasks without a regulator."""

import numpy as np
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.errors import UsageError
from rlcli.evaluation.lqr import regulator, riccati
from rlcli.evaluation.stress import run_points
from rlcli.evaluation.stress_parameters import read_sweeps
from rlcli.registry import find_task

MODEL = """
<mujoco><worldbody><body name="block">
  <joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="2" contype="0" conaffinity="0"/>{more}
</body></worldbody></mujoco>
"""
TASK = """
decimation: 1
episode_length_s: 0.5
sim: {dt: 0.01, engine_threads: 1}
scene: {num_envs: 4, entities: {robot: {model: model.xml}}}
actions: {push: {func: joint_effort, joints: [slide], scale: 20.0}}
observations: {policy: {vel: {func: joint_vel_rel, scale: 0.5}, pos: {func: joint_pos_rel, history: 2}}}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
success: {slide: {func: joint_error, joints: [slide], at_most: 0.1, hold_s: 0.1}}
"""


@pytest.fixture
def task(tmp_path):
    """task(*overrides) -> configuration of a sliding block."""

    def make(*overrides, more="", text=TASK):
        (tmp_path / "task.yaml").write_text(text)
        (tmp_path / "model.xml").write_text(MODEL.format(more=more))
        return resolve(find_task(str(tmp_path)), overrides=overrides)

    return make


def test_riccati_of_a_scalar_system():
    # p = q + a^2 p r / (r + b^2 p) with a = b = q = r = 1: p^2 = p + 1, the golden ratio; k = p / (1 + p)
    one = np.ones((1, 1))
    golden = (1 + 5**0.5) / 2
    assert riccati(one, one, one, one)[0, 0] == pytest.approx(golden / (1 + golden))


def test_riccati_returns_none_if_not_stabilisable():
    unstable = np.diag([1.1, 0.9])
    assert riccati(unstable, np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)) is None


@pytest.mark.parametrize("bound", [1.0, 4.0, None])
def test_regulator_gain_of_a_sliding_block(task, bound):
    # 2 kg at 20 N: v+ = v + 0.1 u, x+ = x + 0.01 v+ (semi-implicit Euler)
    a, b = np.array([[1.0, 0.01], [0.0, 1.0]]), np.array([[0.001], [0.1]])
    wanted = riccati(a, b, np.eye(2), np.eye(1) / (bound or 1.0) ** 2)
    found = regulator(task(), bound)
    x, v = 0.02, -0.06
    # what is observed of x and v: half of v, the position a step ago and now
    seen = np.array([[v / 2, x - 0.01 * v, x]])
    action = -(found.gain @ (seen[0] - found.rest))
    assert action[0] == pytest.approx(float((-wanted @ np.array([x, v]))[0]), rel=0.02)
    assert found.poles[0] < 1.0


def test_regulator_clamps_actions_to_the_bound(task):
    resolved = task()

    class Env:
        device = torch.device("cpu")

    far = torch.full((3, 3), 100.0)
    assert regulator(resolved, 0.5).acting(Env)(far).abs().tolist() == [[0.5]] * 3
    assert float(regulator(resolved, None).acting(Env)(far).abs().min()) > 0.5


@pytest.mark.parametrize("name", ["cartpole", "cartpole-direct"])
def test_regulator_balances_the_cartpoles(name):
    resolved = resolve(find_task(name), play=True, overrides=["scene.num_envs=60", "sim.engine_threads=1"])
    bound = resolved.agent.action_bound
    (found,) = run_points(resolved, regulator(resolved, bound).acting, [], [None], 60, 42)
    assert sum(found.successes) >= 59


@pytest.mark.parametrize(
    ("overrides", "more", "output"),
    [
        (["success.slide=null"], "", "defines no condition of success"),
        (["success.slide.target=1.0"], "", "does not succeed at the default state"),
        (["observations.policy.pos=null"], "", "do not determine the state: slide"),
        (["observations.policy.vel=null", "observations.policy.pos.history=1"], "", "the velocity of slide"),
        ([], '<body name="ball" pos="0 0 1"><joint type="ball"/><geom size="0.1"/></body>', "a ball joint"),
        (
            [],
            '<body name="arm" pos="0 0 1"><joint name="swing" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body>',
            "not an equilibrium: the velocity of swing moves",
        ),
        (
            [],
            '<body name="cup" pos="0 0 1"><joint name="cup" type="slide" axis="0 1 0"/><geom size="0.1"/></body>'
            '<body name="ball" pos="0 0 1.19"><joint name="ball" type="slide" axis="0 0 1"/><geom size="0.1"/></body>',
            "the velocity of ball moves (contacts there: 1)",
        ),
    ],
)
def test_regulator_refuses_a_task_with_the_reason(task, overrides, more, output):
    with pytest.raises(UsageError) as caught:
        regulator(task(*overrides, more=more), 1.0)
    assert output in caught.value.message
    assert "cannot be computed, because" in caught.value.message


@pytest.mark.slow
def test_regulator_is_equal_on_the_warp_engine():
    found = {}
    for engine in ("batch", "warp"):
        settings = ["scene.num_envs=3", f"sim.engine={engine}", "sim.engine_threads=1", "episode_length_s=0.7"]
        resolved = resolve(find_task("cartpole"), play=True, overrides=settings)
        sweeps = read_sweeps(["body_mass.pole=1,4", "push.slider_to_cart=0,2", "action_noise=0,0.1"], 5)
        points = [None, (1.0, 0.0, 0.0), (4.0, 0.0, 0.0), (1.0, 2.0, 0.0), (1.0, 0.0, 0.1)]
        law = regulator(resolved, 1.0)
        results = run_points(resolved, law.acting, sweeps, points, 3, 42)
        assert results[0].returns == results[1].returns
        found[engine] = [*law.gain[0].tolist(), *(value for result in results for value in result.returns)]
    assert found["warp"] == pytest.approx(found["batch"], rel=1e-4)
    assert len(set(found["batch"])) == 4 + 4 * 3
