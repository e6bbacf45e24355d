"""Perturbations of a stress test in real environments, against values computed by hand."""

import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import UsageError
from rlcli.evaluation.perturbations import Perturbations
from rlcli.evaluation.stress_parameters import read_sweeps
from rlcli.registry import find_task

MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" contype="0" conaffinity="0" friction="0.9"/>
    <body name="block"><joint name="slide" type="slide" axis="0 0 1" damping="0.5"/>
      <geom name="box" type="box" size=".1 .1 .1" mass="2" contype="0" conaffinity="0" friction="0.5"/>
      <body name="arm" pos="0 0 .1"><joint name="hinge" type="hinge" axis="0 0 1"/>
        <geom name="rod" type="capsule" size=".02 .1" mass="1" contype="0" conaffinity="0"/></body></body>
    <body name="weightless" pos="1 0 0"/>
  </worldbody>
</mujoco>
"""
TASK = """
decimation: 1
episode_length_s: 0.1
sim: {dt: 0.01, engine_threads: 1, gravity: [0, 0, -10]}
scene:
  num_envs: 4
  ground: null
  entities: {robot: {model: model.xml, joints: {hinge: {effort_limit: 3.0}}}}
actions:
  turn: {func: joint_effort, joints: [hinge]}
observations:
  policy: {pos: {func: joint_pos_rel}, vel: {func: joint_vel_rel}}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
"""
BALL = """
<mujoco><worldbody>
  <body name="ball"><freejoint/><geom size="0.1" mass="1" contype="0" conaffinity="0"/>
    <body name="lid"><joint name="hinge" damping="1"/><geom size="0.01" mass="1e-6" contype="0" conaffinity="0"/></body>
  </body>
</worldbody></mujoco>
"""


@pytest.fixture
def world(tmp_path):
    """world(*overrides, shared_streams=...) -> an environment after a reset."""

    def make(*overrides, shared_streams=0, model=MODEL, task=TASK):
        (tmp_path / "task.yaml").write_text(task)
        (tmp_path / "model.xml").write_text(model)
        env = make_env(resolve(find_task(str(tmp_path)), overrides=overrides), seed=3, shared_streams=shared_streams)
        env.reset(seed=3)
        return env

    return make


def perturb(env, text, *values):
    """Apply a sweep `NAME=...` with a value for each environment."""
    sweeps = read_sweeps([text], 5)
    return Perturbations(env, sweeps, torch.tensor(values, dtype=torch.float64)[:, None])


def speeds(env, steps=1, action=0.0, joint=0):
    """Return the velocity of a joint after some steps. (num_envs,)"""
    for _ in range(steps):
        env.step(torch.full((env.num_envs, env.layout.action_size), action))
    return env.engine.field("qvel")[:, joint].clone()


def test_gravity_as_a_factor_and_as_a_value(world):
    env = world("scene.entities.robot.joints.slide.damping=0")
    perturb(env, "gravity=0:3", 1.0, 0.0, 2.0, 3.0)
    assert speeds(env).tolist() == pytest.approx([-0.1, 0.0, -0.2, -0.3])
    env = world("scene.entities.robot.joints.slide.damping=0")
    perturb(env, "gravity=abs:1:2", 1.0, 2.0, 9.81, float("nan"))
    assert speeds(env).tolist() == pytest.approx([-0.01, -0.02, -0.0981, -0.1])


def test_mass_scales_its_inertia(world):
    env = world()
    alike = speeds(env, 1, 1.0, joint=1)
    env = world()
    perturb(env, "body_mass.arm=0.5:2", 1.0, 0.5, 2.0, 4.0)
    # the same torque on an inertia f times as large
    assert speeds(env, 1, 1.0, joint=1).tolist() == pytest.approx((alike / torch.tensor([1.0, 0.5, 2.0, 4.0])).tolist())
    env = world()
    perturb(env, "body_mass.arm=abs:1:8", 1.0, 2.0, 8.0, float("nan"))
    assert env.engine.expanded("body_mass")[:, 2].tolist() == [1.0, 2.0, 8.0, 1.0]
    assert speeds(env, 1, 1.0, joint=1).tolist() == pytest.approx((alike / torch.tensor([1.0, 2.0, 8.0, 1.0])).tolist())


def test_mass_updates_derived_constants(world):
    env = world()
    perturb(env, "body_mass=0.5:2", 1.0, 0.5, 2.0, 1.0)
    alone = float(env.engine.model.body_subtreemass[1])
    assert [float(env.world(i)[0].body_subtreemass[1]) for i in range(4)] == pytest.approx(
        [alone, 0.5 * alone, 2 * alone, alone]
    )


def test_damping_friction_gains_and_effort_limits(world):
    env = world()
    perturb(env, "joint_damping.slide=1:4", 1.0, 2.0, 4.0, 0.0)
    assert env.engine.expanded("dof_damping")[:, 0].tolist() == [0.5, 1.0, 2.0, 0.0]
    env = world()
    perturb(env, "joint_damping.hinge=abs:0:1", 0.0, 0.5, 1.0, float("nan"))
    assert env.engine.expanded("dof_damping")[:, 1].tolist() == [0.0, 0.5, 1.0, 0.0]
    env = world()
    perturb(env, "geom_friction=0.5:2", 1.0, 0.5, 2.0, 0.0)
    sliding = env.engine.expanded("geom_friction")[:, :, 0]
    assert sliding[:, 0].tolist() == pytest.approx([0.9, 0.45, 1.8, 0.0])  # of the floor, too
    assert sliding[:, 1].tolist() == pytest.approx([0.5, 0.25, 1.0, 0.0])
    assert env.engine.expanded("geom_friction")[2, 0, 1:].tolist() == env.engine.model.geom_friction[0, 1:].tolist()
    plain = speeds(world(), 1, 1.0, joint=1)
    env = world()
    perturb(env, "actuator_gain.hinge=0.5:2", 1.0, 0.5, 2.0, 0.0)
    assert speeds(env, 1, 1.0, joint=1).tolist() == pytest.approx((plain * torch.tensor([1, 0.5, 2, 0])).tolist())
    env = world()
    perturb(env, "effort_limit.hinge=0.5:2", 1.0, 0.5, 2.0, 0.1)
    strong = speeds(env, 1, 100.0, joint=1)  # far beyond every limit
    assert (strong / plain).tolist() == pytest.approx([3.0, 1.5, 6.0, 0.3])
    env = world()
    perturb(env, "effort_limit.hinge=abs:0.5:2", 1.0, 0.5, 2.0, float("nan"))
    assert (speeds(env, 1, -100.0, joint=1) / plain).tolist() == pytest.approx([-1.0, -0.5, -2.0, -3.0])


def test_model_field_by_its_name(world):
    env = world()
    perturb(env, "dof_armature.hinge=abs:0:2", 0.0, 0.5, 1.0, 2.0)
    assert env.engine.expanded("dof_armature")[:, 1].tolist() == [0.0, 0.5, 1.0, 2.0]
    env = world()
    perturb(env, "geom_size.rod=1:2", 1.0, 1.5, 2.0, 1.0)
    assert env.engine.expanded("geom_size")[:, 2, 1].tolist() == pytest.approx([0.1, 0.15, 0.2, 0.1])


def test_values_drawn_by_events_are_scaled_once(world):
    drawn = (
        "events.mass={func: randomize_body_mass, mode: reset, bodies: [arm], operation: set, range: [2.0, 6.0]}",
        "events.damp={func: randomize_joint_damping, mode: interval, interval_range_s: [0.03, 0.03],"
        " joints: [slide], operation: set, range: [1.0, 9.0]}",
    )
    plain, other = world(*drawn), world(*drawn)
    sweeps = read_sweeps(["body_mass.arm=0.5:2", "joint_damping.slide=0.5:2"], 5)
    perturbations = Perturbations(
        other, sweeps, torch.tensor([[1.0, 1.0], [0.5, 2.0], [2.0, 1.0], [4.0, 0.5]], dtype=torch.float64)
    )
    masses = set()
    for _ in range(35):
        for env in (plain, other):
            env.step(torch.zeros(4, 1))
        perturbations.before_step()  # as the next step will begin
        factor = other.engine.expanded("body_mass")[:, 2] / plain.engine.expanded("body_mass")[:, 2]
        assert factor.tolist() == pytest.approx([1.0, 0.5, 2.0, 4.0])
        factor = other.engine.expanded("dof_damping")[:, 0] / plain.engine.expanded("dof_damping")[:, 0]
        assert factor.tolist() == pytest.approx([1.0, 2.0, 1.0, 0.5])
        masses.add(float(plain.engine.expanded("body_mass")[0, 2]))
    assert len(masses) == 4  # drawn anew in each of the four episodes


def test_sweeps_of_one_field_multiply_in_any_order(world):
    event = (
        "events.mass={func: randomize_body_mass, mode: reset, bodies: [arm], operation: set, range: [2.0, 6.0],"
        " with_inertia: false}"
    )
    for names in (
        ("body_mass", "body_mass.arm", "body_inertia.arm"),
        ("body_inertia.arm", "body_mass.arm", "body_mass"),
    ):
        plain, other = world(event), world(event)
        factor = {"body_mass": 2.0, "body_mass.arm": 3.0, "body_inertia.arm": 5.0}
        sweeps = read_sweeps([f"{name}=1:9" for name in names], 5)
        values = torch.tensor([[factor[name] for name in names]] * 4, dtype=torch.float64)
        perturbations = Perturbations(other, sweeps, values)
        for _ in range(25):
            for env in (plain, other):
                env.step(torch.zeros(4, 1))
            perturbations.before_step()
            mass, inertia = other.engine.expanded("body_mass"), other.engine.expanded("body_inertia")
            assert mass[:, 1].tolist() == [4.0] * 4
            assert (mass[:, 2] / plain.engine.expanded("body_mass")[:, 2]).tolist() == pytest.approx([6.0] * 4)
            own = torch.tensor(other.engine.model.body_inertia[2])
            assert (inertia[:, 2] / own).flatten().tolist() == pytest.approx([30.0] * 12)


class Counting:
    """Policy whose action is the step number, and that stores its observations."""

    def __init__(self, env):
        self.env, self.seen = env, []

    def __call__(self, obs):
        self.seen.append(obs.clone())
        return torch.full((self.env.num_envs, 1), float(len(self.seen)))


def run_policy(env, perturbed, steps):
    """Return the perturbed actions and the unperturbed observations. (steps, num_envs, k) each"""
    obs, done, shown = env.reset(seed=3)["policy"], [], []
    for _ in range(steps):
        shown.append(obs.clone())
        action = perturbed(obs)
        done.append(action.clone())
        obs = env.step(action).obs["policy"]
    return torch.stack(done), torch.stack(shown)


def test_action_delay_starts_with_zero(world):
    env = world()
    done, _ = run_policy(env, perturb(env, "action_delay=0:3", 0, 1, 2, 3).around(Counting(env)), 23)
    for row in range(4):
        # episodes of ten steps: at the begin of each nothing has come through yet
        wanted = [float(t + 1 - row) if t % 10 >= row else 0.0 for t in range(23)]
        assert done[:, row, 0].tolist() == wanted


def test_observation_delay_repeats_the_first_observation(world):
    env = world("events.start={func: reset_joints_by_offset, mode: reset, position: [-1.0, 1.0]}")
    policy = Counting(env)
    _, shown = run_policy(env, perturb(env, "observation_delay=0:3", 0, 1, 2, 3).around(policy), 23)
    seen = torch.stack(policy.seen)
    for row in range(4):
        for t in range(23):
            late = t - min(row, t % 10)
            assert torch.equal(seen[t, row], shown[late, row]), (row, t)


def test_noise_has_its_standard_deviation(world):
    env = world("scene.num_envs=400")
    policy = Counting(env)
    values = [0.0] * 200 + [0.3] * 200
    done, shown = run_policy(env, perturb(env, "observation_noise=0:1", *values).around(policy), 10)
    noise = torch.stack(policy.seen) - shown
    assert torch.equal(noise[:, :200], torch.zeros_like(noise[:, :200]))
    assert float(noise[:, 200:].std()) == pytest.approx(0.3, rel=0.05)
    assert abs(float(noise[:, 200:].mean())) < 0.02
    assert not torch.equal(noise[0, 200:], noise[1, 200:])
    assert done[:, 0, 0].tolist() == [float(t + 1) for t in range(10)]


def test_noise_and_delay_of_a_single_term(world):
    env = world()
    policy = Counting(env)
    _, shown = run_policy(env, perturb(env, "observation_noise.vel=0:1", 1.0, 1.0, 1.0, 1.0).around(policy), 5)
    changed = (torch.stack(policy.seen) != shown).any(dim=0).any(dim=0).tolist()
    assert changed == [False, False, True, True]
    env = world()
    policy = Counting(env)
    _, shown = run_policy(env, perturb(env, "observation_noise.pos.hinge=0:1", 1.0, 1.0, 1.0, 1.0).around(policy), 5)
    assert (torch.stack(policy.seen) != shown).any(dim=0).any(dim=0).tolist() == [False, True, False, False]


def test_shared_streams_get_equal_noise_and_pushes(world):
    env = world(shared_streams=2)
    policy = Counting(env)
    run_policy(env, perturb(env, "observation_noise=0:1", 0.5, 0.5, 0.5, 0.5).around(policy), 5)
    seen = torch.stack(policy.seen)
    assert torch.equal(seen[:, :2], seen[:, 2:])
    assert not torch.equal(seen[:, 0], seen[:, 1])
    env = world(shared_streams=2)
    perturb(env, "push.hinge=0:1", 1.0, 1.0, 1.0, 1.0)
    for _ in range(9):
        turning = speeds(env, joint=1)
        assert torch.equal(turning[:2], turning[2:])


def test_joint_is_pushed_once_in_the_first_half_of_an_episode(world):
    env = world("scene.num_envs=40")
    perturb(env, "push.hinge=0:5", *([0.0] * 20 + [3.0] * 20))
    speed = torch.stack([speeds(env, joint=1) for _ in range(9)])
    assert torch.equal(speed[:, :20], torch.zeros(9, 20, dtype=speed.dtype))
    jumps = speed.diff(dim=0, prepend=torch.zeros(1, 40, dtype=speed.dtype))[:, 20:]
    assert ((jumps.abs() > 1.0).sum(dim=0) == 1).all()
    assert speed[-1, 20:].abs().tolist() == pytest.approx([3.0] * 20, rel=1e-3)
    assert {-1.0, 1.0} == set(speed[-1, 20:].sign().tolist())
    assert int((jumps.abs() > 1.0).nonzero()[:, 0].max()) <= 5


def test_floating_entity_is_pushed_horizontally(world):
    env = world("scene.num_envs=30", "sim.gravity=[0, 0, 0]", model=BALL)
    perturb(env, "push=0:5", *([2.0] * 30))
    for _ in range(9):
        env.step(torch.zeros(30, env.layout.action_size))
    velocity = env.engine.field("qvel")[:, :3]
    assert velocity.norm(dim=1).tolist() == pytest.approx([2.0] * 30)
    assert float(velocity[:, 2].abs().max()) < 1e-9
    assert len({round(float(v), 3) for v in velocity[:, 0]}) > 20


@pytest.mark.parametrize(
    ("text", "output", "hint"),
    [
        ("body_mas.arm=1:2", "there is no parameter 'body_mas'", "did you mean 'body_mass'"),
        ("body_mass.amr=1:2", "no body matches 'amr'", "did you mean 'arm'"),
        ("joint_damping.hing=1:2", "no joint matches 'hing'", "did you mean 'hinge'"),
        ("joint_damping.hinge=1:2", "joint_damping is 0 for hinge", "abs:"),
        ("body_mass.weightless=1:2", "0 for weightless", "abs:"),
        ("effort_limit.slide=1:2", "no actuator matches 'slide'", "hinge"),
        ("gravity.arm=1:2", "to the whole world, not to an element", "leave out 'arm'"),
        ("tendon_stiffness=1:2", "the model has no tendons", None),
        ("geom_size.rod=abs:1:2", "`abs:` would set all 3 values of geom_size to one number", "leave out `abs:`"),
        ("observation_noise.poss=0:1", "no observation matches 'poss'", "did you mean 'pos'"),
        ("action_delay.trun=0:1", "no action matches 'trun'", "did you mean 'turn'"),
        ("push=0:1", "no entity has a floating base", "push.NAME"),
        ("push.hing=0:1", "matches 'hing'", "hinge"),
        ("push..*=0:1", "matches several names", "write one of these names"),
    ],
)
def test_invalid_perturbation_is_refused_with_a_hint(world, text, output, hint):
    env = world()
    with pytest.raises(UsageError) as caught:
        perturb(env, text, 1.0, 1.0, 1.0, 1.0)
    assert output in caught.value.message
    assert hint is None or hint in (caught.value.hint or "")


def test_gravity_factor_without_gravity_is_refused(world):
    env = world("sim.gravity=[0, 0, 0]")
    with pytest.raises(UsageError, match="0 for the world"):
        perturb(env, "gravity=1:2", 1.0, 1.0, 1.0, 1.0)
