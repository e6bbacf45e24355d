"""Tests of the work that steps skip: it changes no result."""

import _ctypes
import ctypes
import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from mujoco.batch import Batch

from rlcli.config.load import resolve
from rlcli.config.schema import SimConfig
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.sim.engine import open_engine
from rlcli.sim.mujoco_private import without_profiler
from rlcli.sim.skippable_work import colliding_pairs, skippable_flags

CONTACT, ISLAND, CONSTRAINT = (
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in ("CONTACT", "ISLAND", "CONSTRAINT")
)
ALL = CONTACT | ISLAND | CONSTRAINT
FLOOR = '<geom type="plane" size="5 5 1"/>'


def model_of(body, more="", options="", flags=""):
    option = f"<option {options}><flag {flags}/></option>"
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{body}</worldbody>{more}</mujoco>")


def slider(inside="", *, name="cart", geom='<geom size="0.1"/>', joint=""):
    return f'<body name="{name}"><joint name="{name}" type="slide" axis="0 0 1" {joint}/>{geom}{inside}</body>'


def engine_of(model, num_envs=3, **more):
    return open_engine(model, num_envs, SimConfig(dt=model.opt.timestep, engine_threads=2), device="cpu", **more)


GHOST = '<geom name="ghost" size="0.1" contype="0" conaffinity="0"/>'
TARGET = '<body name="target" mocap="true" pos="0 0 0.05"><geom size="0.1"/></body>'
PAIR = '<geom name="floor" type="plane" size="5 5 1" contype="0" conaffinity="0"/>'


@pytest.mark.parametrize(
    ("model", "flags"),
    [
        pytest.param(model_of(FLOOR + slider(geom=GHOST)), ALL, id="no bits"),
        pytest.param(model_of(slider()), ALL, id="alone"),
        pytest.param(model_of(FLOOR + slider()), ISLAND, id="floor"),
        pytest.param(model_of(slider() + slider(name="other")), 0, id="two"),
        pytest.param(model_of(slider(slider(name="child"))), ALL, id="child"),
        pytest.param(model_of(slider(slider(name="c")), flags="filterparent='disable'"), ISLAND, id="unfiltered"),
        pytest.param(
            model_of(FLOOR + slider(), "<contact><exclude body1='world' body2='cart'/></contact>"),
            ALL,
            id="excluded",
        ),
        pytest.param(
            model_of(PAIR + slider(geom=GHOST), "<contact><pair geom1='floor' geom2='ghost'/></contact>"),
            ISLAND,
            id="pair",
        ),
        pytest.param(model_of(FLOOR + slider(), options='solver="PGS"'), 0, id="pgs"),
        pytest.param(model_of(FLOOR + slider(), options='noslip_iterations="3"'), 0, id="noslip"),
        pytest.param(model_of(slider(), flags="sleep='enable'"), CONTACT, id="sleep"),
        pytest.param(model_of(slider(joint="range='0 1' limited='true'")), CONTACT | ISLAND, id="limit"),
        pytest.param(model_of(slider(joint="frictionloss='1'")), CONTACT | ISLAND, id="friction"),
        pytest.param(
            model_of(slider(), "<equality><joint joint1='cart'/></equality>"), CONTACT | ISLAND, id="equality"
        ),
        pytest.param(model_of(FLOOR + TARGET + slider(geom=GHOST)), ALL, id="mocap"),
        pytest.param(model_of(FLOOR + TARGET + slider()), ISLAND, id="mocap and floor"),
    ],
)
def test_skippable_flags_of_models(model, flags):
    assert skippable_flags(model) == flags


@pytest.mark.parametrize("seed", range(12))
def test_colliding_pairs_equal_mujoco_contacts(seed):
    """Make overlapping balls in random kinematic trees with random contact bits."""
    random = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    if seed % 3 == 2:
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    bodies = [spec.worldbody]
    for n in range(9):
        body = bodies[random.integers(len(bodies))].add_body(name=f"body{n}")
        body.mocap = body.parent == spec.worldbody and seed % 2 == 1
        if not body.mocap and random.random() < 0.6:
            body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[1, 0, 0])
        bodies.append(body)
    for body in bodies:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.3, 0, 0],
            mass=1.0,
            pos=random.uniform(-0.05, 0.05, 3),
            contype=int(random.integers(4)),
            conaffinity=int(random.integers(4)),
        )
    for a, b in random.integers(9, size=(2, 2)):
        if a != b:
            spec.add_exclude(bodyname1=f"body{a}", bodyname2=f"body{b}")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    met = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    assert set(colliding_pairs(model)) == met
    assert bool(skippable_flags(model) & CONTACT) == (not met)


TASKS = [
    *(
        "cartpole",
        "ingenuity",
        "quadcopter",
        "ant-direct",
        "humanoid",
        "quadruped-flat",
        "quadruped-rough",
        "ball-balance",
        "biped-velocity",
    ),
    *("crazyflie", "hand-reorient", "lift-cube", "open-drawer", "reach-ik"),
]


@pytest.mark.parametrize("task", TASKS)
def test_states_equal_batch_without_skipped_work(task):
    env = make_env(resolve(find_task(task), flags={"scene.num_envs": 8}), seed=0)
    env.reset(seed=0)
    engine, model = env.engine, env.engine.model
    whole = Batch(model, 8, 2)
    for name in engine.expanded_fields():  # model fields that the task randomises
        whole.expand(name)[:] = engine.expand(name).numpy()
    if engine.own_constants:
        whole.set_const()
    whole.state[:] = engine.state_rows(np.arange(8))
    random = np.random.default_rng(0)
    ctrl, low, high = engine.field("ctrl"), *model.actuator_ctrlrange.T
    touched = 0
    for _ in range(60):
        values = random.uniform(np.where(high > low, low, -1.0), np.where(high > low, high, 1.0), (8, model.nu))
        ctrl[:] = torch.from_numpy(values)
        whole.bind("ctrl")[:] = values
        engine.step(4)
        whole.step(nstep=4)
        np.testing.assert_array_equal(engine.state_rows(np.arange(8)), whole.state)
        touched += int(whole.bind("ncon").sum()) if skippable_flags(model) & CONTACT else 1
    assert (touched == 0) == bool(skippable_flags(model) & CONTACT)


@pytest.fixture
def clock_reads():
    """Count how often MuJoCo reads the clock, which is replaced by a C function."""
    count = [0]

    @ctypes.CFUNCTYPE(ctypes.c_double)
    def clock():
        count[0] += 1
        return float(count[0])

    mujoco.set_mjcb_time(clock)
    yield count
    mujoco.set_mjcb_time(None)


def test_engine_calls_do_not_read_clock(clock_reads):
    model = model_of(FLOOR + slider())
    engine = engine_of(model)
    engine.field("xpos")
    before = clock_reads[0]
    engine.step(2)
    assert clock_reads[0] == before
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert clock_reads[0] > before, "other simulations read the clock as before"
    assert data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0


def test_clock_is_restored_after_error_and_parallel_steps(clock_reads):
    with pytest.raises(RuntimeError), without_profiler:
        raise RuntimeError
    model = model_of(slider())
    engines = [engine_of(model) for _ in range(4)]
    together = threading.Barrier(4)

    def work(engine):
        together.wait()
        for _ in range(300):
            engine.step(1)

    threads = [threading.Thread(target=work, args=(engine,)) for engine in engines]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    before = clock_reads[0]
    mujoco.mj_step(model, mujoco.MjData(model))
    assert clock_reads[0] > before


def test_clock_set_during_step_is_kept(clock_reads):
    with without_profiler:
        mujoco.set_mjcb_time(None)  # the clock of the bindings
    before = clock_reads[0]
    data = mujoco.MjData(model_of(slider()))
    mujoco.mj_step(data.model, data)
    assert clock_reads[0] == before
    assert data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0


@pytest.mark.parametrize("found", [None, b"no library", "another"])
def test_profiler_stays_on_for_unknown_library_layout(found, tmp_path, monkeypatch, clock_reads):
    if found == "another":
        (tmp_path / "libmujoco.so").symlink_to(_ctypes.__file__)
    elif found:
        (tmp_path / "libmujoco.so").write_bytes(found)
    monkeypatch.setattr(mujoco, "__file__", str(tmp_path / "__init__.py"))
    other = type(without_profiler)()
    with other:
        before = clock_reads[0]
        mujoco.mj_step(model := model_of(slider()), mujoco.MjData(model))
        assert clock_reads[0] > before


def test_expanded_contact_bits_enable_contacts():
    """Drop a ball through a floor without contacts, then enable the contacts in one world."""
    model = model_of(FLOOR + f'<body pos="0 0 0.15"><freejoint/>{GHOST}</body>')
    engine = engine_of(model)
    assert engine.step(100) is None
    assert (engine.field("qpos")[:, 2] < 0.0).all(), "the ball falls through the floor"
    engine.reset(every := engine.select(torch.ones(3, dtype=torch.bool), 0, torch.zeros(3, dtype=torch.int64)))
    assert every is not None
    engine.expand("geom_contype")[1, 1] = engine.expand("body_contype")[1, 1] = 1
    engine.step(100)
    assert engine.field("qpos")[0, 2] < 0.0
    assert engine.field("qpos")[1, 2] > 0.09
    assert "opt.disableflags" not in engine.expanded_fields()
    assert set(engine.state_dict()) >= {"model.geom_contype"}
    assert "model.opt.disableflags" not in engine.state_dict()


def test_expanded_friction_enables_constraints():
    engine = engine_of(model_of(slider(geom=GHOST), options="gravity='0 0 -1'"))
    engine.step(10)
    assert (engine.field("qvel") < 0.0).all()
    engine.expand("body_gravcomp")
    engine.expand("dof_frictionloss")[1] = 1000.0
    engine.step(200)
    speed = engine.field("qvel")[:, 0].abs().tolist()
    assert speed[1] < 0.01 < speed[0]


def test_binding_island_fields_enables_islands():
    model = model_of(FLOOR + slider())
    engine = engine_of(model)
    engine.step(1)
    assert engine.field("nisland").tolist() == [1] * 3
    engine.step(1)
    assert engine.field("nisland").tolist() == [1] * 3


def test_write_own_model_keeps_original_flags():
    model = model_of(slider(), options="gravity='0 0 -5'")
    engine = engine_of(model)
    assert model.opt.disableflags == 0
    assert engine.world(0)[0].opt.disableflags == 0
    engine.expand("body_mass")
    assert engine.world(1)[0].opt.disableflags == 0
    mine = model_of(slider())
    engine.write_own_model(2, mine)
    assert (mine.opt.disableflags, mine.opt.gravity[2]) == (0, -5.0)
    engine.expand("opt.disableflags")[1] = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    engine.step(10)
    assert engine.field("qvel")[:, 0].tolist()[1] == 0.0
    assert engine.world(1)[0].opt.disableflags == int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)


def test_later_changes_of_model_flags_have_no_effect():
    model = model_of(slider())
    engine = engine_of(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    engine.step(1)
    fallen = engine.field("qvel").clone()
    engine.expand("jnt_limited")
    engine.step(1)
    torch.testing.assert_close(engine.field("qvel"), 2.0 * fallen)
    assert engine.world(0)[0].opt.disableflags == 0


def test_engines_made_in_threads_do_not_change_model():
    model = model_of(slider())

    def work():
        for _ in range(100):
            engine_of(model, 1)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    seen = set()
    while any(thread.is_alive() for thread in threads):
        seen.add(model.opt.disableflags)
    assert seen | {model.opt.disableflags} == {0}


@pytest.mark.parametrize("engine", ["batch", "warp"])
def test_distance_sensor_works_for_geoms_without_contacts(engine):
    far = slider(
        slider(name="child", geom='<geom name="b" size="0.1" contype="0" conaffinity="0" pos="1 0 0"/>'), geom=GHOST
    )
    model = model_of(far, '<sensor><distance geom1="ghost" geom2="b" cutoff="10"/></sensor>')
    worlds = open_engine(model, 2, SimConfig(dt=model.opt.timestep, engine=engine), device="cpu")
    values = worlds.field("sensordata")
    worlds.step(1)
    assert values.flatten().tolist() == pytest.approx([0.8, 0.8], abs=1e-5)


def test_mujoco_library_is_found():
    """Check that the library is found: without it the engine is a third slower, and no other test fails."""
    assert list(Path(mujoco.__file__).parent.glob("libmujoco*")), "another layout: see rlcli/sim/mujoco_private.py"
