"""Tests of derived fields with values of the last physics step, and of contact forces on bodies."""

import re

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER

from rlcli.config.schema import SimConfig
from rlcli.sim.engine import open_engine

torch.set_num_threads(1)

N = 4
RK4 = '<option integrator="RK4"/>'
XML = (
    re.sub("<sensor>.*</sensor>", "", CRITTER)
    .replace("<worldbody>", f'{RK4}<worldbody><geom type="plane" size="5 5 1"/>')
    .replace("</mujoco>", '<actuator><position joint="hip_fl" kp="20" kv="0.5"/></actuator></mujoco>')
)
"""Model without sensors that make MuJoCo compute forces on bodies."""
POSITION, VELOCITY, FORCE = ("xpos", "xipos", "cinert"), ("cvel",), ("qacc", "qfrc_actuator", "qfrc_constraint")
FIELDS = (*POSITION, *VELOCITY, *FORCE)


def engine_of(kind="batch", xml=XML, **settings):
    model = mujoco.MjModel.from_xml_string(xml)
    return open_engine(model, N, SimConfig(dt=model.opt.timestep, engine=kind, **settings))


def select(engine, *ids):
    mask = torch.tensor([i in ids for i in range(engine.num_envs)])
    return engine.select(mask, 0, torch.zeros(N, dtype=torch.int64))


def place_worlds(engine):
    """Place each world a little higher than the one before; all but the highest touch the ground."""
    everyone = select(engine, *range(N))
    engine.reset(everyone)
    height = torch.tensor([0.26, 0.265, 0.27, 2.0]).to(engine.field("qpos").dtype)
    engine.field("qpos")[:, 2] = height
    engine.field("ctrl")[:] = 0.2
    engine.forward(everyone)


def forwarded_worlds(engine):
    """Return the worlds as MjData after `mj_forward`."""
    worlds = []
    for i in range(N):
        data = mujoco.MjData(engine.model)
        for name in ("qpos", "qvel", "ctrl"):
            getattr(data, name)[:] = engine.field(name)[i].double().numpy()
        mujoco.mj_forward(engine.model, data)
        worlds.append(data)
    return worlds


def test_substep_fields_equal_mj_step_bit_for_bit():
    engine = engine_of(derived_fields="substep", external_forces=True)
    for name in (*FIELDS, "cfrc_ext"):
        engine.field(name)
    place_worlds(engine)
    worlds = forwarded_worlds(engine)
    felt = np.zeros(N)
    for _ in range(30):
        engine.step(3)
        for i, data in enumerate(worlds):
            mujoco.mj_step(engine.model, data, 3)
            mujoco.mj_rnePostConstraint(engine.model, data)
            for name in ("qpos", "qvel", *FIELDS, "cfrc_ext"):
                np.testing.assert_array_equal(engine.field(name)[i].numpy(), getattr(data, name), err_msg=name)
            felt[i] += np.abs(data.cfrc_ext).sum()
    assert (felt[:3] > 0).all()
    assert felt[3] == 0


def test_substep_fields_belong_to_state_before_step():
    late, current = engine_of(derived_fields="substep"), engine_of()
    for engine in (late, current):
        engine.field("xpos")
        place_worlds(engine)
    late.step(1)
    current.step(1)
    np.testing.assert_array_equal(late.field("qpos").numpy(), current.field("qpos").numpy())
    assert not torch.equal(late.field("xpos"), current.field("xpos"))
    torch.testing.assert_close(current.field("xpos")[:, 1], current.field("qpos")[:, :3])


@pytest.mark.slow  # Warp compiles the Runge-Kutta kernels
def test_substep_fields_agree_between_engines():
    settings = {"derived_fields": "substep", "external_forces": True}
    host, device = engine_of("batch", **settings), engine_of("warp", **settings)
    for engine in (host, device):
        for name in (*FIELDS, "cfrc_ext"):
            engine.field(name)
        place_worlds(engine)
    for step in range(4):
        host.step(2)
        device.step(2)
        for name in (*FIELDS, "cfrc_ext"):
            expected, found = host.field(name), device.field(name).double()
            error = float((found.view(expected.shape) - expected).abs().max() / expected.abs().max().clamp(min=1.0))
            assert error < 2e-3, f"step {step}: {name} {error:.1e}"
    assert float(device.field("cfrc_ext").abs().sum()) > 0


@pytest.mark.parametrize("kind", ["batch", pytest.param("warp", marks=pytest.mark.slow)])
def test_reset_clears_substep_forces_of_selected_worlds(kind):
    engine = engine_of(kind, derived_fields="substep", external_forces=True)
    forces, place = engine.field("cfrc_ext"), engine.field("xpos")
    place_worlds(engine)
    engine.step(2)
    felt, late = forces.clone(), place.clone()
    assert all(felt[i].abs().sum() > 0 for i in range(3))
    engine.reset(select(engine, 1))
    engine.forward(select(engine, 1))
    assert not forces[1].any()
    torch.testing.assert_close(place[1, 1], engine.field("qpos")[1, :3])
    for world in (0, 2, 3):
        assert torch.equal(forces[world], felt[world])
        assert torch.equal(place[world], late[world])


def test_external_force_is_computed_without_contact():
    engine = engine_of(external_forces=True)
    forces, push = engine.field("cfrc_ext"), engine.field("xfrc_applied")
    place_worlds(engine)
    push[3, 1, 2] = 5.0
    engine.step(1)
    assert float(forces[3, 1, 5]) == pytest.approx(5.0)


@pytest.mark.parametrize("kind", ["batch", pytest.param("warp", marks=pytest.mark.slow)])
def test_load_state_dict_restores_fields_bound_later(kind):
    settings = {"derived_fields": "substep", "external_forces": True}
    engine = engine_of(kind, **settings)
    names = ("xpos", "cvel", "qacc", "cfrc_ext")
    for name in names:
        engine.field(name)
    place_worlds(engine)
    engine.step(3)
    kept, state = {name: engine.field(name).clone() for name in names}, engine.state_dict()
    other = engine_of(kind, **settings)
    other.load_state_dict(state)
    for name in names:
        assert torch.equal(other.field(name), kept[name]), name
