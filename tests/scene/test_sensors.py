"""Tests of contact and ray sensors in states with known forces and distances."""

import math

import pytest
import torch
from support.worlds import CRITTER_TASK, actions, build, critter, dump, edited, write

from rlcli.errors import ConfigError

torch.set_num_threads(1)

BOX = """
<mujoco><worldbody>
  <body name="box" pos="0 0 0.1"><freejoint/>
    <geom type="box" size="0.1 0.1 0.1" mass="{mass}"/>
    <body name="tag" pos="0 0 0.1"><inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/></body>
  </body>
</worldbody></mujoco>
"""
CART = """
<mujoco><worldbody><body name="cart" pos="0 5 1"><joint name="slide" type="slide"/>
  <geom size="0.1" contype="0" conaffinity="0" mass="1"/></body></worldbody></mujoco>
"""
TASK = {
    "decimation": 5,
    "episode_length_s": 100.0,
    "sim": {"dt": 0.004},
    "scene": {
        "num_envs": 3,
        "entities": {
            "low": {"model": "low.xml"},
            "high": {"model": "high.xml", "pos": [0.0, 0.0, 0.3]},
            "robot": {"model": "cart.xml"},
        },
    },
    "actions": {"push": {"func": "joint_effort"}},
    "observations": {"policy": {"pos": {"func": "joint_pos"}}},
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}
ENGINES = pytest.mark.parametrize("engine", ["batch", "warp"])
MANY_STEPS = pytest.mark.parametrize("engine", ["batch", pytest.param("warp", marks=pytest.mark.slow)])


def boxes(tmp_path, sensors, *overrides, num_envs=3, **changes):
    """Make environments with a box of 1 kg on a box of 2 kg on the ground, and a distant cart for the actions."""
    task = edited(dump(TASK), scene={"sensors": sensors}, **changes)
    folder = write(tmp_path / "boxes", task, low_xml=BOX.format(mass=2), high_xml=BOX.format(mass=1), cart_xml=CART)
    env = build(folder, num_envs, *overrides)
    env.reset()
    return env


def rest(env, steps=60):
    for _ in range(steps):
        env.step(torch.zeros(env.num_envs, env.layout.action_size))


def contact(**settings):
    return {"kind": "contact", **settings}


# --- contact ---


@MANY_STEPS
def test_contact_force_acts_on_body_in_world_frame(tmp_path, engine):
    env = boxes(tmp_path, {
        "low": contact(entity="low", bodies="box"),
        "high": contact(entity="high", bodies="box"),
        "low_ground": contact(entity="low", bodies="box", against="ground"),
        "high_ground": contact(entity="high", bodies="box", against="ground"),
        "low_high": contact(entity="low", bodies="box", against={"entity": "high"}),
        "high_low": contact(entity="high", bodies="box", against={"entity": "low", "bodies": "box"}),
    }, f"sim.engine={engine}")  # fmt: skip
    rest(env, 25)
    g = 9.81
    up = {"low": 2 * g, "high": g, "low_ground": 3 * g, "high_ground": 0.0, "low_high": -g, "high_low": g}
    for name, force in up.items():
        expected = torch.tensor([0.0, 0.0, force]).expand(3, 1, 3)
        torch.testing.assert_close(env.sensors[name].force, expected, atol=0.02, rtol=0, msg=name)
        assert env.sensors[name].found.tolist() == [[force != 0.0]] * 3, name


@MANY_STEPS
def test_contact_force_includes_friction(tmp_path, engine):
    env = boxes(tmp_path, {"low": contact(entity="low", bodies="box", against="ground")}, f"sim.engine={engine}")
    rest(env, 5)
    env.engine.field("xfrc_applied").view(3, -1)[:, 6:7] = 4.0  # along x, on the first body after the world
    rest(env, 5)
    torch.testing.assert_close(env.sensors["low"].force[:, 0, 0], torch.full((3,), -4.0), atol=0.05, rtol=0)


def test_contact_slots_have_order_of_configuration(tmp_path):
    task = edited(dump(TASK), scene={"entities": {
        "left": {"model": "low.xml", "pos": [-0.12, 0.0, 0.1]},
        "right": {"model": "low.xml", "pos": [0.12, 0.0, 0.1]},
        "plank": {"model": "plank.xml", "pos": [0.0, 0.0, 0.225]},
        "robot": {"model": "cart.xml"},
    }, "sensors": {
        "plank": contact(entity="plank", bodies=["plank"], against={"entity": "left", "bodies": ["box"]}),
        "both": contact(entity="plank", bodies=["plank"]),
        "links": contact(entity="robot", bodies=["wheel", "cart"]),
    }})  # fmt: skip
    plank = """<mujoco><worldbody><body name="plank"><freejoint/>
      <geom type="box" size="0.3 0.1 0.025" mass="4"/></body></worldbody></mujoco>"""
    cart = CART.replace(
        'contype="0" conaffinity="0" mass="1"/>', 'mass="1"/><body name="wheel"><geom size="0.2"/></body>'
    )
    env = build(write(tmp_path / "t", task, low_xml=BOX.format(mass=2), plank_xml=plank, cart_xml=cart))
    assert env.sensors["links"].names == ["wheel", "cart"]
    env.reset()
    rest(env)
    half, whole = env.sensors["plank"].force[0, 0, 2], env.sensors["both"].force[0, 0, 2]
    assert float(half) == pytest.approx(2 * 9.81, abs=0.05)
    assert float(whole) == pytest.approx(4 * 9.81, abs=0.05)


def test_contact_forces_of_several_partners_are_summed(tmp_path):
    env = boxes(tmp_path, {
        "all": contact(entity="low", bodies="box", against={"entity": "high", "bodies": ["box", "tag"]}),
        "one": contact(entity="low", bodies="box", against={"entity": "high", "bodies": ["box"]}),
    })  # fmt: skip
    rest(env, 10)
    assert torch.equal(env.sensors["all"].force, env.sensors["one"].force)
    assert float(env.sensors["all"].force[0, 0, 2]) < -5.0


@MANY_STEPS
def test_air_and_contact_times_count_steps(tmp_path, engine):
    """Drop a box from 0.2 m: it falls for sqrt(2 h / g) = 0.202 s, in steps of 0.02 s."""
    entities = {"low": {"pos": [0.0, 0.0, 0.3]}, "high": {"pos": [9.0, 0.0, 0.1]}}
    env = boxes(tmp_path, {"box": contact(entity="low", bodies="box", history=3)}, f"sim.engine={engine}",
                *(f"scene.entities.{n}.pos={e['pos']}" for n, e in entities.items()))  # fmt: skip
    sensor = env.sensors["box"]
    assert not sensor.found.any()
    seen = []
    for step in range(1, 16):
        previous = sensor.force_history.clone()
        env.step(torch.zeros(3, 1))
        assert torch.equal(sensor.force_history[:, 1:], previous[:, :-1])
        assert torch.equal(sensor.force_history[:, 0], sensor.force)
        seen.append(bool(sensor.found[0, 0]))
        if not any(seen):
            assert sensor.air_time[0, 0] == pytest.approx(0.02 * step)
            assert not sensor.first_contact.any()
        elif seen.count(True) == 1:
            landed = step
            assert sensor.first_contact.all()
            assert sensor.air_time.max() == 0.0
            assert sensor.last_air_time[0, 0] == pytest.approx(0.02 * step)
            assert sensor.contact_time[0, 0] == pytest.approx(0.02)
        else:
            assert not sensor.first_contact.any()
            assert sensor.contact_time[0, 0] == pytest.approx(0.02 * (step - landed + 1))
    assert landed in (11, 12)  # contact is detected one substep after it begins
    assert seen[landed - 1 :] == [True] * (16 - landed)
    env.engine.field("qvel")[:, 2] = 2.0  # thrown up
    env.step(torch.zeros(3, 1))
    assert sensor.first_air.all()
    assert sensor.last_contact_time[0, 0] == pytest.approx(0.02 * (16 - landed + 1))
    assert sensor.air_time[0, 0] == pytest.approx(0.02)
    assert sensor.contact_time.max() == 0.0


@ENGINES
def test_reset_clears_contact_times_of_selected_environments(tmp_path, engine):
    env = boxes(tmp_path, {"box": contact(entity="low", bodies="box", history=2)}, f"sim.engine={engine}")
    sensor = env.sensors["box"]
    rest(env, 5)
    before = {name: value.clone() for name, value in sensor.state_dict().items()}
    chosen = env._select(torch.tensor([False, True, False]))
    env._reset_envs(chosen)
    for name, value in sensor.state_dict().items():
        assert torch.equal(value[[0, 2]], before[name][[0, 2]]), name
    assert before["contact_time"][1, 0] == pytest.approx(0.1)
    for name in ("contact_time", "air_time", "last_contact_time", "first_contact"):
        assert not getattr(sensor, name)[1].any(), name
    assert not sensor.force_history[1, 1].any()
    assert torch.equal(sensor.force_history[1, 0], sensor.force[1])


def test_force_threshold_defines_contact(tmp_path):
    env = boxes(tmp_path, {
        "light": contact(entity="high", bodies="box", force_threshold=9.0),
        "heavy": contact(entity="high", bodies="box", force_threshold=11.0),
    })  # fmt: skip
    rest(env)
    assert env.sensors["light"].found.all()
    assert not env.sensors["heavy"].found.any()
    assert env.sensors["heavy"].force[0, 0, 2] > 9.0


@ENGINES
def test_body_without_colliding_geom_reads_zero(tmp_path, engine):
    sensors = {"all": contact(entity="low", bodies=".*"), "some": contact(entity="low", bodies=["tag", "box"])}
    env = boxes(tmp_path, sensors, f"sim.engine={engine}")
    rest(env, 5)
    for name, (solid, empty) in {"all": (0, 1), "some": (1, 0)}.items():
        sensor = env.sensors[name]
        assert (sensor.names[solid], sensor.names[empty]) == ("box", "tag")
        assert sensor.force[:, solid, 2].min() > 5.0
        assert not sensor.force[:, empty].any()
        assert sensor.found.tolist() == [[index == solid for index in range(2)]] * 3
        assert sensor.air_time[:, empty].tolist() == pytest.approx([0.1] * 3)


# --- rays ---

TOWER = """
<mujoco><worldbody>
  <body name="mast" pos="0 0 0"><freejoint/>
    <geom name="self" size="0.05" contype="0" conaffinity="0"/>
    <body name="head" pos="0.5 0 1"><joint name="pan" axis="0 0 1"/>
      <geom type="box" size="0.02 0.02 0.02" contype="0" conaffinity="0"/></body>
  </body>
</worldbody></mujoco>
"""
WALL = """
<mujoco><worldbody><body name="wall" pos="3 0 1"><geom type="box" size="0.5 10 1"/></body></worldbody></mujoco>
"""


def tower(tmp_path, sensors, *overrides, **scene):
    task = edited(dump(TASK), scene={
        "entities": {"robot": {"model": "tower.xml", "pos": [0.0, 0.0, 2.0]}, "wall": {"model": "wall.xml"}},
        "sensors": sensors, **scene,
    }, sim={"gravity": [0.0, 0.0, 0.0]})  # fmt: skip
    env = build(write(tmp_path / "tower", task, tower_xml=TOWER, wall_xml=WALL), 3, *overrides)
    env.reset()
    return env


def pose(env, position, quat, pan=0.0):
    everyone = env._select_all()
    robot = env.entities["robot"]
    robot.write_root_pose(everyone, torch.tensor([position]).expand(3, 3), torch.tensor([quat]).expand(3, 4))
    robot.write_joint_positions(everyone, torch.full((3, 1), pan))
    env.engine.forward(everyone)
    env.sim.refresh()
    for sensor in env.sensors.values():
        sensor.update(env.step_dt)


DOWN = {"pattern": [[0.0, 0.0, -1.0]], "lookup": True}


def rays(**settings):
    return {"kind": "rays", **settings}


@ENGINES
def test_ray_sensor_returns_distances_hits_and_misses(tmp_path, engine):
    env = tower(tmp_path, {
        "eye": rays(pattern=[[0.0, 0.0, -2.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, -1.0]], sees="all",
                    offset=[0.0, 0.0, -0.5], max_distance=4.0),
    }, f"sim.engine={engine}")  # fmt: skip
    pose(env, [0.0, 0.0, 2.0], [1.0, 0.0, 0.0, 0.0])
    eye = env.sensors["eye"]
    # from (0, 0, 1.5): the ground below, the wall's face at x = 2.5, nothing behind, the ground again at 45 degrees
    torch.testing.assert_close(eye.position, torch.tensor([[0.0, 0.0, 1.5]]).expand(3, 3))
    expected = torch.tensor([1.5, 2.5, 4.0, 1.5 * math.sqrt(2)])
    torch.testing.assert_close(eye.distance, expected.expand(3, 4), atol=1e-5, rtol=0)
    assert eye.missed[0].tolist() == [False, False, True, False]
    hits = torch.tensor([[0.0, 0.0, 0.0], [2.5, 0.0, 1.5], [-4.0, 0.0, 1.5], [1.5, 0.0, 0.0]])
    torch.testing.assert_close(eye.hits, hits.expand(3, 4, 3), atol=1e-5, rtol=0)


@ENGINES
def test_ray_alignment_selects_rotation_of_pattern(tmp_path, engine):
    """Turn the body by 90 degrees about z, then roll it by 30 degrees about its own x axis."""
    grid = {"size": [1.0, 0.0], "resolution": 1.0}
    env = tower(tmp_path, {
        name: rays(pattern=grid, offset=[0.0, 0.2, 0.0], alignment=name) for name in ("base", "yaw", "world")
    }, f"sim.engine={engine}")  # fmt: skip
    c, s = math.cos(math.pi / 12), math.sin(math.pi / 12)
    half = math.sqrt(0.5)
    pose(env, [0.0, 0.0, 1.0], [half * c, half * s, half * s, half * c])
    position = {"world": [0.0, 0.2, 1.0], "yaw": [-0.2, 0.0, 1.0], "base": [-0.2 * math.cos(math.pi / 6), 0.0, 1.1]}
    for name, expected in position.items():
        torch.testing.assert_close(env.sensors[name].position[0], torch.tensor(expected), atol=1e-5, rtol=0)
    # one ray starts 0.5 m behind the sensor, one 0.5 m ahead of it
    world, yaw, base = (env.sensors[name].hits[0] for name in ("world", "yaw", "base"))
    torch.testing.assert_close(world, torch.tensor([[-0.5, 0.2, 0.0], [0.5, 0.2, 0.0]]), atol=1e-5, rtol=0)
    torch.testing.assert_close(yaw, torch.tensor([[-0.2, -0.5, 0.0], [-0.2, 0.5, 0.0]]), atol=1e-5, rtol=0)
    # down in the body's frame is (-sin 30, 0, -cos 30) in the world
    x = -0.2 * math.cos(math.pi / 6) - 1.1 * math.tan(math.pi / 6)
    torch.testing.assert_close(base, torch.tensor([[x, -0.5, 0.0], [x, 0.5, 0.0]]), atol=1e-5, rtol=0)
    torch.testing.assert_close(env.sensors["base"].distance[0], torch.full((2,), 1.1 / math.cos(math.pi / 6)))


@ENGINES
def test_ray_sensor_moves_with_body(tmp_path, engine):
    env = tower(tmp_path, {"eye": rays(body="head", pattern=[[1.0, 0.0, 0.0]], sees="all")}, f"sim.engine={engine}")
    pose(env, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(env.sensors["eye"].distance, torch.full((3, 1), 2.0), atol=1e-5, rtol=0)
    pose(env, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], pan=math.pi / 3)
    torch.testing.assert_close(env.sensors["eye"].distance, torch.full((3, 1), 4.0), atol=1e-4, rtol=0)


def test_ray_grid_runs_along_x_first_and_includes_both_ends(tmp_path):
    env = tower(tmp_path, {"scan": rays(pattern={"size": [1.6, 1.0], "resolution": 0.1})})
    hits = env.sensors["scan"].hits[0]
    assert hits.shape == (17 * 11, 3)
    torch.testing.assert_close(hits[0], torch.tensor([-0.8, -0.5, 0.0]))
    torch.testing.assert_close(hits[1], torch.tensor([-0.7, -0.5, 0.0]))
    torch.testing.assert_close(hits[17], torch.tensor([-0.8, -0.4, 0.0]))
    torch.testing.assert_close(hits[-1], torch.tensor([0.8, 0.5, 0.0]))


@pytest.mark.parametrize(("sees", "distance"), [("ground", 2.0), ("all", 0.48), ([3], 0.48), ([4], 10.0)])
def test_ray_hits_only_selected_geom_groups(tmp_path, sees, distance):
    """Cast rays down from 2 m; a plate of geom group 3 with a half thickness of 0.02 m is 0.5 m below."""
    plate = WALL.replace('pos="3 0 1"', 'pos="0 0 1.5"').replace('size="0.5 10 1"', 'size="1 1 0.02" group="3"')
    task = edited(dump(TASK), sim={"gravity": [0.0, 0.0, 0.0]}, scene={
        "entities": {"robot": {"model": "tower.xml", "pos": [0.0, 0.0, 2.0]}, "plate": {"model": "plate.xml"}},
        "sensors": {"eye": rays(pattern=[[0.0, 0.0, -1.0]], sees=sees)},
    })  # fmt: skip
    env = build(write(tmp_path / "plate", task, tower_xml=TOWER, plate_xml=plate), 2)
    env.reset()
    torch.testing.assert_close(env.sensors["eye"].distance, torch.full((2, 1), distance), atol=1e-5, rtol=0)


@ENGINES
def test_rays_are_cast_once_per_step_and_after_reset(tmp_path, engine, monkeypatch):
    env = tower(tmp_path, {"eye": rays(pattern=[[0.0, 0.0, -1.0]])}, f"sim.engine={engine}")
    casts = []
    cast = env.engine.rays
    monkeypatch.setattr(env.engine, "rays", lambda *a, **k: casts.append(k["selection"]) or cast(*a, **k))
    eye = env.sensors["eye"]
    env.step(torch.zeros(3, 1))
    assert casts == []
    assert float(eye.distance[0, 0]) == pytest.approx(2.0)
    assert len(eye.hits) == 3
    assert casts == [None]
    env.engine.field("qpos")[:, 2] += 1.0
    env.sim.refresh()
    chosen = env._select(torch.tensor([False, True, False]))
    env._reset_envs(chosen)
    assert eye.distance[:, 0].tolist() == pytest.approx([2.0, 2.0, 2.0])
    assert casts == [None, chosen]
    env.step(torch.zeros(3, 1))
    assert eye.distance[:, 0].tolist() == pytest.approx([3.0, 2.0, 3.0])


# --- terms, many environments, checkpoints ---

TERMS = """
from rlcli.task import ContactSensor, RaySensor


def grip(env, *, sensor: ContactSensor):
    \"\"\"Net forces, found, and times of the bodies. (num_envs, 6 k)\"\"\"
    import torch
    return torch.cat([sensor.force.flatten(1), sensor.found.float(), sensor.air_time, sensor.contact_time], dim=1)


def scan(env, *, sensor: RaySensor | None = None):
    \"\"\"Heights below the sensor [m]. (num_envs, r)\"\"\"
    import torch
    if sensor is None:
        return torch.zeros(env.num_envs, 1)
    return sensor.position[:, 2:] - sensor.hits[..., 2]
"""
FEET = {"feet": contact(bodies=["leg_br", "leg_fl"], against="ground", history=2),
        "body": rays(pattern={"size": [0.4, 0.2], "resolution": 0.1}, alignment="yaw")}  # fmt: skip


def sensing_critter(tmp_path, num_envs, *overrides, sensors=FEET, grip=None, seed=42):
    policy = {"grip": {"func": "grip", "sensor": "feet", **(grip or {})}, "scan": {"func": "scan", "sensor": "body"},
              "none": {"func": "scan"}}  # fmt: skip
    task = edited(CRITTER_TASK, scene={"sensors": sensors}, observations={"policy": policy})
    return build(critter(tmp_path, task, terms_py=TERMS), num_envs, *overrides, seed=seed)


def rollout(env, steps):
    env.reset()
    return [env.step(a).obs["policy"].clone() for a in actions(steps, env.num_envs, env.layout.action_size)]


def test_sensor_readings_are_independent_of_num_envs(tmp_path):
    many = rollout(sensing_critter(tmp_path / "a", 19), 50)
    few = rollout(sensing_critter(tmp_path / "b", 3), 50)
    assert all(torch.equal(a[:3], b) for a, b in zip(many, few, strict=True))
    assert torch.stack(few)[..., 6:8].mean() > 0.1  # the feet touch the ground at times
    assert not torch.equal(few[0][0], few[0][1])


def test_sensor_readings_agree_between_engines(tmp_path):
    host = sensing_critter(tmp_path / "a", 4)
    device = sensing_critter(tmp_path / "b", 4, "sim.engine=warp")
    for env in (host, device):
        env.reset(seed=1)
    # contact forces amplify rounding errors: compare only the first steps, in which the legs touch down
    for action in actions(4, 4, 4):
        one, other = host.step(0.3 * action).obs["policy"], device.step(0.3 * action).obs["policy"]
        torch.testing.assert_close(one, other, atol=0.2, rtol=0.02)
        torch.testing.assert_close(one[:, 12:], other[:, 12:], atol=1e-3, rtol=0)


def test_state_dict_restores_contact_times_and_history(tmp_path):
    env = sensing_critter(tmp_path / "a", 4)
    rollout(env, 12)
    state = env.state_dict()
    assert {"sensors.feet.air_time", "sensors.feet.force_history"} <= state.keys()
    draws = actions(20, 4, 4, seed=3)
    expected = [env.step(a).obs["policy"].clone() for a in draws]
    other = sensing_critter(tmp_path / "b", 4, seed=7)
    other.reset()
    other.load_state_dict(state)
    found = [other.step(a).obs["policy"].clone() for a in draws]
    assert all(torch.equal(a, b) for a, b in zip(expected, found, strict=True))


# --- errors ---


@pytest.mark.parametrize(
    ("sensor", "message", "hint"),
    [
        (contact(entity="robto", bodies="x"), "feet.entity: no entity 'robto'", "did you mean 'robot'"),
        (contact(bodies=["leg_fl", "leg_xx"]), "feet.bodies: no body matches 'leg_xx'", "did you mean"),
        (contact(bodies=["leg_fl", "leg_.l"]), "feet.bodies: body 'leg_fl' is matched twice", None),
        (contact(bodies=["torso"], against={"entity": "robot", "bodies": "arm"}), "feet.against.bodies: no body", None),
        (contact(bodies=["torso"], against={"entity": "wall"}), "feet.against.entity: no entity 'wall'", "robot"),
        (contact(bodies=["torso"], against="grund"), "feet.against: expected 'ground'", "did you mean 'ground'"),
        (contact(), "feet: missing key 'bodies'", None),
        (contact(bodies="torso", hisotry=2), "feet.hisotry: unknown key", "did you mean 'history'"),
        ({"bodies": "torso"}, "feet: missing key 'kind'", "contact"),
        ({"kind": "contct", "bodies": "torso"}, "feet.kind: expected 'contact' or 'rays' or 'camera'", "'contact'"),
        (rays(pattern={"size": [1, 1], "resolution": 0}), "pattern.resolution: expected a number > 0", None),
        (rays(pattern=[[0, 0, 0]]), "feet.pattern.0: a direction must not be zero", None),
        (rays(pattern=[]), "feet.pattern: ", None),
        (rays(pattern=[[0, 0, -1]], body="leg_.*"), "feet.body: 'leg_.*' matches several bodies", "name one body"),
        (rays(pattern=[[0, 0, -1]], body="head"), "feet.body: no body matches 'head'", "torso"),
        (rays(pattern=[[0, 0, -1]], sees=[6]), "feet.sees", None),
        (rays(pattern=[[0, 1, -1]], lookup=True, alignment="yaw"), "feet: lookup needs rays straight down", None),
        (rays(**DOWN), "feet: lookup needs rays straight down", None),
        (rays(**DOWN, alignment="yaw", sees="all"), "feet: lookup needs rays that hit", None),
        (rays(**DOWN, alignment="yaw"), "feet.lookup: heights cannot be looked up: the scene has no terra",
         "lookup: false"),
    ],
)  # fmt: skip
def test_invalid_sensor_raises_config_error_with_key(tmp_path, sensor, message, hint):
    task = edited(CRITTER_TASK, scene={"sensors": {"feet": sensor}})
    with pytest.raises(ConfigError) as error:
        build(critter(tmp_path, task), 2)
    text = "\n".join(str(problem) for problem in error.value.problems)
    assert "scene.sensors." + message in text or message in text
    assert hint is None or hint in text


def test_contact_sensor_on_body_without_contacts_is_refused(tmp_path):
    with pytest.raises(
        ConfigError, match=r"x.bodies: no geom of tag can have contacts; bodies whose geoms can have contacts: box$"
    ):
        boxes(tmp_path, {"x": contact(entity="low", bodies=["tag"])})


def test_ground_sensor_without_ground_is_refused(tmp_path):
    with pytest.raises(ConfigError) as error:
        boxes(tmp_path, {"a": contact(entity="low", bodies="box", against="ground"),
                         "b": rays(entity="low", pattern=[[0.0, 0.0, -1.0]])}, "scene.ground=null")  # fmt: skip
    assert [problem.path for problem in error.value.problems] == ["scene.sensors.a.against", "scene.sensors.b.sees"]


@pytest.mark.parametrize(
    ("name", "message", "hint"),
    [("feed", "no sensor 'feed' of kind contact in scene.sensors", "did you mean 'feet'"),
     ("body", "sensor 'body' is of kind rays, the term needs one of kind contact", "sensors of this kind: feet")],
)  # fmt: skip
def test_term_with_unknown_sensor_is_refused(tmp_path, name, message, hint):
    with pytest.raises(ConfigError) as error:
        sensing_critter(tmp_path, 2, grip={"sensor": name})
    text = str(error.value)
    assert f"observations.policy.grip.sensor: {message}" in text
    assert hint in text
