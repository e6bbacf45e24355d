"""Tests of entities that are shapes: static props, falling objects, and several entities of one kind."""

import math

import mujoco
import pytest
import torch
from support.worlds import CRITTER_TASK, actions, build, critter, dump, edited, results_of_env, run, same, write

from rlcli.errors import ConfigError

torch.set_num_threads(1)

CART = """
<mujoco><option integrator="implicitfast"/><worldbody><body name="cart" pos="0 50 1"><joint name="slide" type="slide"/>
  <geom size="0.1" contype="0" conaffinity="0" mass="1"/></body></worldbody></mujoco>
"""
TASK = {
    "decimation": 2,
    "episode_length_s": 100.0,
    "sim": {"dt": 0.005},
    "scene": {"num_envs": 2, "entities": {"robot": {"model": "cart.xml"}}},
    "actions": {"push": {"func": "joint_effort"}},
    "observations": {"policy": {"pos": {"func": "joint_pos"}}},
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}
ENGINES = pytest.mark.parametrize("engine", ["batch", pytest.param("warp", marks=pytest.mark.slow)])


def scene(tmp_path, entities, *overrides, num_envs=2, **changes):
    """Make environments with the given entities first and a distant cart last."""
    task = edited(dump(TASK), scene={"entities": {**entities, **TASK["scene"]["entities"]}}, **changes)
    env = build(write(tmp_path / "shapes", task, cart_xml=CART), num_envs, *overrides)
    env.reset()
    return env


def rest(env, steps):
    for _ in range(steps):
        env.step(torch.zeros(env.num_envs, 1))


def free(shape, size, pos, **more):
    return {"shape": shape, "size": size, "pos": pos, "free": True, **more}


@ENGINES
def test_free_shape_rests_at_height_of_its_size(tmp_path, engine):
    env = scene(tmp_path, {
        "box": free("box", [0.4, 0.3, 0.2], [0.0, 0.0, 0.12], mass=2.0),
        "ball": free("sphere", [0.15], [2.0, 0.0, 0.16], mass=1.0),
        "can": free("cylinder", [0.2, 0.3], [4.0, 0.0, 0.16], density=500.0),
        "pill": free("capsule", [0.1, 0.4], [6.0, 0.0, 0.11], quat=[math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]),
    }, f"sim.engine={engine}")  # fmt: skip
    rest(env, 150)
    for name, height in {"box": 0.1, "ball": 0.15, "can": 0.15, "pill": 0.1}.items():
        assert env.entities[name].data.root_pos_w[:, 2].tolist() == pytest.approx([height] * 2, abs=2e-3), name


@ENGINES
def test_cone_rests_on_its_base_and_a_shape_without_collisions_falls_through_the_ground(tmp_path, engine):
    env = scene(tmp_path, {
        "cone": free("cone", [0.2, 0.4], [0.0, 0.0, 0.21], mass=1.0),
        "ghost": free("sphere", [0.1], [2.0, 0.0, 0.1], collides=False),
    }, f"sim.engine={engine}")  # fmt: skip
    rest(env, 60)
    assert env.entities["cone"].data.root_pos_w[:, 2].tolist() == pytest.approx([0.2] * 2, abs=2e-3)
    assert (env.entities["ghost"].data.root_pos_w[:, 2] < -1.0).all()


def test_mass_and_density_are_written_to_model(tmp_path):
    model = scene(tmp_path, {
        "heavy": free("box", [0.4, 0.3, 0.2], [0.0, 0.0, 1.0], mass=7.0),
        "dense": free("box", [0.4, 0.3, 0.2], [2.0, 0.0, 1.0], density=500.0),
        "water": free("sphere", [0.1], [4.0, 0.0, 1.0]),
        "can": free("cylinder", [0.1, 0.5], [6.0, 0.0, 1.0]),
    }).engine.model  # fmt: skip
    mass = {name: float(model.body(f"{name}/body").mass[0]) for name in ("heavy", "dense", "water", "can")}
    assert mass["heavy"] == pytest.approx(7.0)
    assert mass["dense"] == pytest.approx(0.4 * 0.3 * 0.2 * 500.0)
    assert mass["water"] == pytest.approx(4 / 3 * math.pi * 0.1**3 * 1000.0)
    assert mass["can"] == pytest.approx(math.pi * 0.1**2 * 0.5 * 1000.0)


def test_static_shape_supports_falling_object(tmp_path):
    env = scene(tmp_path, {
        "table": {"shape": "box", "size": [1.0, 1.0, 0.1], "pos": [0.0, 0.0, 0.75]},
        "floor": {"shape": "plane", "size": [4.0, 4.0], "pos": [10.0, 0.0, 0.3]},
        "ball": free("sphere", [0.1], [0.0, 0.0, 1.0]),
        "other": free("sphere", [0.1], [10.0, 0.0, 0.5]),
    })  # fmt: skip
    rest(env, 150)
    assert env.entities["ball"].data.root_pos_w[:, 2].tolist() == pytest.approx([0.9] * 2, abs=2e-3)
    assert env.entities["other"].data.root_pos_w[:, 2].tolist() == pytest.approx([0.4] * 2, abs=2e-3)
    assert env.entities["table"].data.root_pos_w.tolist() == [pytest.approx([0.0, 0.0, 0.75])] * 2
    assert not env.entities["table"].is_floating


def test_shape_friction_determines_sliding(tmp_path):
    """Place a box on a slope of 20 degrees: it stays if its friction is above tan 20 = 0.364."""
    half = math.radians(10.0)
    turn = [math.cos(half), 0.0, math.sin(half), 0.0]
    normal = torch.tensor([math.sin(2 * half), 0.0, math.cos(2 * half)]) * (0.05 + 0.1)
    entities = {}
    for name, y, friction in (("slippery", 0.0, 0.2), ("rough", 2.0, 0.6)):
        entities[f"{name}_slope"] = {"shape": "box", "size": [4.0, 1.0, 0.1], "pos": [0.0, y, 3.0], "quat": turn,
                                     "friction": friction}  # fmt: skip
        at = (torch.tensor([0.0, y, 3.0]) + normal).tolist()
        entities[name] = free("box", [0.2, 0.2, 0.2], at, quat=turn, friction=friction)
    env = scene(tmp_path, entities)
    rest(env, 50)
    start = {name: torch.tensor(entities[name]["pos"]) for name in ("slippery", "rough")}
    slid = {name: float((env.entities[name].data.root_pos_w[0] - start[name]).norm()) for name in start}
    # 0.5 g (sin 20 - 0.2 cos 20) t^2 after 0.5 s
    expected = 0.5 * 9.81 * (math.sin(2 * half) - 0.2 * math.cos(2 * half)) * 0.25
    assert slid["slippery"] == pytest.approx(expected, rel=0.05)
    assert slid["rough"] < 0.01


@ENGINES
def test_default_root_velocity_is_in_world_frame(tmp_path, engine):
    half = math.sqrt(0.5)
    env = scene(tmp_path, {
        "ball": free("sphere", [0.1], [0.0, 0.0, 5.0], quat=[half, half, 0.0, 0.0],
                     init={"lin_vel": [1.0, 2.0, 3.0], "ang_vel": [0.1, 0.2, 0.3]}),
    }, f"sim.engine={engine}", sim={"gravity": [0.0, 0.0, 0.0]})  # fmt: skip
    ball = env.entities["ball"].data
    torch.testing.assert_close(ball.root_lin_vel_w, torch.tensor([[1.0, 2.0, 3.0]] * 2))
    torch.testing.assert_close(ball.root_ang_vel_w, torch.tensor([[0.1, 0.2, 0.3]] * 2))
    rest(env, 50)
    torch.testing.assert_close(ball.root_pos_w, torch.tensor([[0.5, 1.0, 6.5]] * 2), atol=1e-4, rtol=0)
    env._reset_envs(env._select(torch.tensor([False, True])))
    torch.testing.assert_close(ball.root_lin_vel_w, torch.tensor([[1.0, 2.0, 3.0]] * 2))
    torch.testing.assert_close(ball.root_pos_w[1], torch.tensor([0.0, 0.0, 5.0]))


@ENGINES
def test_mocap_shape_moves_objects_and_returns_at_reset(tmp_path, engine):
    env = scene(tmp_path, {
        "lift": {"shape": "box", "size": [1.0, 1.0, 0.2], "pos": [0.0, 0.0, 0.1], "mocap": True},
        "ball": free("box", [0.1, 0.1, 0.1], [0.0, 0.0, 0.25]),
    }, f"sim.engine={engine}")  # fmt: skip
    lift = env.entities["lift"]
    chosen = env._select(torch.tensor([False, True]))
    rows = torch.zeros(len(chosen.read_view(env._counters.ids)), 4)
    rows[:, 0] = 1.0
    for step in range(100):
        height = torch.tensor([0.0, 0.0, 0.1 + 0.002 * step]).expand(len(rows), 3)
        lift.write_root_pose(chosen, height, rows)
        rest(env, 1)
    assert lift.data.root_pos_w[:, 2].tolist() == pytest.approx([0.1, 0.298])
    # the ball starts at rest on the lift; a mocap body has no velocity of its own
    assert env.entities["ball"].data.root_pos_w[:, 2].tolist() == pytest.approx([0.25, 0.25 + 0.198], abs=0.02)
    env._reset_envs(chosen)
    assert lift.data.root_pos_w[:, 2].tolist() == pytest.approx([0.1, 0.1])


def test_options_come_from_first_mjcf_after_shape(tmp_path):
    env = scene(tmp_path, {"box": free("box", [0.2, 0.2, 0.2], [0.0, 0.0, 1.0])})
    assert env.engine.model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


def test_model_attached_twice_gives_equal_trajectories(tmp_path):
    """Compare two distant critters with equal actions to a critter that is alone."""
    events = {"root": None, "joints": None, "push": None, "shove": None}
    pair = {name: {"model": "critter.xml", "pos": [0.0, y, 0.35], "joints": {".*": {"kp": 20.0, "kv": 0.5}}}
            for name, y in (("robot", 0.0), ("other", 8.0))}  # fmt: skip
    legs = {"func": "joint_position", "joints": ["hip_br", "hip_fl", "hip_bl", "hip_fr"], "scale": 0.5}
    task = edited(CRITTER_TASK, scene={"entities": pair}, events=events, rewards={"power": None},
                  actions={"legs": legs, "others": {**legs, "entity": "other"}})  # fmt: skip
    env = build(critter(tmp_path, task), 2)
    env.reset()
    for action in actions(20, 2, 4):
        env.step(action.repeat(1, 2))
    robot, other = (env.entities[name].data for name in ("robot", "other"))
    torch.testing.assert_close(robot.joint_pos, other.joint_pos, atol=1e-4, rtol=0)
    shift = torch.tensor([[0.0, 8.0, 0.0]] * 2)
    torch.testing.assert_close(robot.root_pos_w + shift, other.root_pos_w, atol=1e-4, rtol=0)
    assert float((robot.joint_pos[0] - robot.joint_pos[1]).abs().max()) > 0.05


def test_trajectory_with_objects_is_independent_of_num_envs(tmp_path):
    ball = {"ball": free("sphere", [0.1], [0.3, 0.0, 0.6], mass=0.5)}
    task = edited(CRITTER_TASK, scene={"entities": {
        "robot": {"model": "critter.xml", "joints": {".*": {"kp": 20.0, "kv": 0.5}}}, **ball}})  # fmt: skip
    many, few = (run(build(critter(tmp_path / name, task), n), 30) for name, n in (("a", 17), ("b", 2)))
    assert same(results_of_env(many, 1), results_of_env(few, 1))


@pytest.mark.parametrize(
    ("entity", "message"),
    [
        ({}, "robot: an entity has either `model` (an MJCF file) or `shape`: write one of the two"),
        ({"model": "cart.xml", "shape": "box"}, "robot: an entity has either `model`"),
        ({"model": "cart.xml", "mass": 1.0}, "robot: 'mass' is only allowed with `shape`"),
        ({"model": "cart.xml", "free": True}, "robot: 'free' is only allowed with `shape`"),
        ({"shape": "box"}, "robot: size of a box must be [x, y, z], the lengths of its edges [m]; found none"),
        ({"shape": "box", "size": [1.0]}, "found 1 numbers"),
        ({"shape": "capsule", "size": [1.0, 2.0, 3.0]}, "size of a capsule must be [radius, length]"),
        ({"shape": "box", "size": [1.0, 0.0, 1.0]}, "robot.size.1: expected a number > 0, found 0"),
        ({"shape": "bux", "size": [1.0]}, "robot.shape: expected 'box'"),
        (
            {"shape": "sphere", "size": [1.0], "mass": 1.0, "density": 2.0},
            "mass and density cannot be combined: remove one",
        ),
        (
            {"shape": "sphere", "size": [1.0], "mocap": True, "free": True},
            "free and mocap cannot be combined: remove one",
        ),
        ({"shape": "plane", "size": [1.0, 1.0], "free": True}, "a plane cannot move"),
        ({"shape": "box", "size": [1.0, 1.0, 1.0], "axis": "x"}, "a box has no axis"),
        ({"model": "cart.xml", "collides": False}, "'collides' is only allowed with `shape`"),
        ({"shape": "sphere", "size": [1.0], "mass": 0.0}, "robot.mass: expected a number > 0, found 0"),
        (
            {"shape": "sphere", "size": [1.0], "init": {"lin_vel": [1.0, 0.0, 0.0]}},
            "entity 'robot' has no free joint at its root",
        ),
    ],
)
def test_invalid_shape_raises_config_error_with_key(tmp_path, entity, message):
    task = edited(dump(TASK), scene={"entities": {"robot": entity, "cart": {"model": "cart.xml"}}},
                  actions={"push": {"func": "joint_effort", "entity": "cart"}},
                  observations={"policy": {"pos": {"func": "joint_pos", "entity": "cart"}}})  # fmt: skip
    with pytest.raises(ConfigError) as error:
        build(write(tmp_path / "bad", task, cart_xml=CART), 1)
    assert message in str(error.value)
