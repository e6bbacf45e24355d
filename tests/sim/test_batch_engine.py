"""Tests of the CPU engine: each world equals a simulation in plain MuJoCo."""

import re

import mujoco
import numpy as np
import pytest
import torch
from mujoco.batch import DATA_FIELDS
from support.worlds import CRITTER, PENDULUM

from rlcli.config.schema import SimConfig
from rlcli.errors import ConfigError, DeviceError
from rlcli.sim.engine import open_engine
from rlcli.sim.env_selection import IdSelection
from rlcli.sim.state_cache import SimData

XML = CRITTER.replace("<worldbody>", '<worldbody><geom type="plane" size="5 5 1"/>').replace(
    "</mujoco>",
    "<actuator>" + "".join(f'<position joint="hip_{s}" kp="20" kv="0.5"/>' for s in ("fl", "fr", "bl", "br"))
    + "</actuator></mujoco>",
)  # fmt: skip
N = 6


def model_of(xml=XML):
    return mujoco.MjModel.from_xml_string(xml)


def engine_of(model, num_envs, *, device="cpu", **settings):
    return open_engine(model, num_envs, SimConfig(dt=model.opt.timestep, **settings), device=device)


def selection_of(*ids):
    ids = np.array(ids, dtype=np.int64)
    return IdSelection(ids, 0, np.zeros_like(ids))


def scatter(engine, seed=0):
    """Set different states and controls in every world."""
    random = np.random.default_rng(seed)
    qpos = engine.field("qpos")
    qpos[:, :3] += torch.from_numpy(random.uniform(-0.1, 0.1, (engine.num_envs, 3)))
    qpos[:, 7:] += torch.from_numpy(random.uniform(-0.3, 0.3, (engine.num_envs, 4)))
    engine.field("qvel")[:] = torch.from_numpy(random.uniform(-1, 1, (engine.num_envs, 10)))
    engine.field("ctrl")[:] = torch.from_numpy(random.uniform(-1, 1, (engine.num_envs, 4)))


def test_engine_refuses_more_worlds_than_memory_holds(monkeypatch):
    monkeypatch.setattr("rlcli.machine.memory.available_memory", lambda: 2**30)
    with pytest.raises(DeviceError, match=r"^1000000 environments need at least \d\.\d GiB, 1\.0 GiB are") as no:
        engine_of(model_of(), 1_000_000)
    assert no.value.hint == "use fewer environments: --num-envs"
    assert engine_of(model_of(), 1000).num_envs == 1000


def test_engine_states_the_memory_of_many_worlds_before_it_builds_them(monkeypatch, caplog):
    monkeypatch.setattr("rlcli.machine.memory.available_memory", lambda: 2**24)
    monkeypatch.setattr("rlcli.sim.batch_world_state.make_batch", None)
    with pytest.raises(TypeError):  # nothing is built
        engine_of(model_of(), 3000)
    assert re.search(r"3000 environments need at least 0\.0 GiB of the 0\.0 GiB that are free", caplog.text)
    caplog.clear()
    with pytest.raises(TypeError):
        engine_of(model_of(), 100)
    assert not caplog.text


@pytest.mark.parametrize("threads", [1, 3])
def test_step_equals_mj_step_bit_for_bit(threads):
    model = model_of()
    engine = engine_of(model, N, engine_threads=threads)
    engine.field("xpos")  # so that the last substep computes a stage too
    scatter(engine)
    worlds = []
    for i in range(N):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (engine.field(f)[i].numpy() for f in ("qpos", "qvel", "ctrl"))
        worlds.append(data)
    for _ in range(40):
        engine.step(3)
        for i, data in enumerate(worlds):
            mujoco.mj_step(model, data, 3)
            for name in ("qpos", "qvel", "qacc_warmstart"):
                np.testing.assert_array_equal(engine.field(name)[i].numpy(), getattr(data, name))
    assert any(data.ncon for data in worlds), "contacts occurred"


def test_field_returns_live_view():
    engine = engine_of(model_of(), N)
    qpos, again = engine.field("qpos"), engine.field("qpos")
    qpos[2, 2] = 5.0
    assert again.data_ptr() == qpos.data_ptr()
    before = qpos.clone()
    engine.step(1)
    assert not torch.equal(qpos, before)
    assert float(qpos[2, 2]) == pytest.approx(5.0, abs=0.01)


def test_fields_are_arrays_without_copies_and_warnings():
    """pytest turns warnings into errors; `np.array(tensor)` warns with torch 2.13, whatever the tensor is."""
    engine = engine_of(model_of(), N, external_forces=True)
    fields = {name: engine.field(name) for name in DATA_FIELDS} | {"body_mass": engine.expand("body_mass")}
    for name, field in fields.items():
        array = np.asarray(field)
        assert array.shape == tuple(field.shape), name
        assert array.size == 0 or array.__array_interface__["data"][0] == field.data_ptr(), name
        assert np.array(field.numpy()).base is None, name


def kinematics(engine, i):
    data = mujoco.MjData(engine.model)
    data.qpos[:], data.qvel[:] = engine.field("qpos")[i].numpy(), engine.field("qvel")[i].numpy()
    data.ctrl[:] = engine.field("ctrl")[i].numpy()
    mujoco.mj_forward(engine.model, data)
    return data


def test_derived_fields_match_state_after_step_and_partial_reset():
    engine = engine_of(model_of(), N)
    fields = {name: engine.field(name) for name in ("xpos", "xquat", "cvel", "site_xpos")}
    scatter(engine)
    engine.step(4)
    for i in range(N):
        for name, value in fields.items():
            np.testing.assert_allclose(value[i], getattr(kinematics(engine, i), name), atol=1e-12, rtol=0)
    kept = {name: value.clone() for name, value in fields.items()}
    engine.reset(selection_of(1, 4))
    engine.field("qpos")[4, 0] = 0.7
    engine.forward(selection_of(1, 4))
    for i in range(N):
        for name, value in fields.items():
            np.testing.assert_allclose(value[i], getattr(kinematics(engine, i), name), atol=1e-12, rtol=0)
            assert torch.equal(value[i], kept[name][i]) == (i not in (1, 4))
    assert float(fields["xpos"][4, 1, 0]) == 0.7


def test_gyro_and_accelerometer_match_start_state_after_partial_reset():
    engine = engine_of(model_of(), N)
    sensors = engine.field("sensordata")
    scatter(engine)
    engine.step(4)
    gyro = sensors[0, 3:6].clone()
    np.testing.assert_allclose(gyro, kinematics(engine, 0).sensordata[3:6], atol=1e-12)
    kept = sensors.clone()
    engine.reset(selection_of(2))
    engine.field("qpos")[2, 2], engine.field("ctrl")[2] = 0.25, 0.3  # on its feet, in contact with the ground
    engine.forward(selection_of(2))
    assert abs(kinematics(engine, 2).sensordata[2]) > 5.0
    np.testing.assert_allclose(sensors[2], kinematics(engine, 2).sensordata, atol=1e-9)
    assert torch.equal(sensors[[0, 1, 3, 4, 5]], kept[[0, 1, 3, 4, 5]])


def test_acceleration_fields_have_values_of_last_substep():
    model = model_of()
    engine = engine_of(model, 1)
    qacc, force = engine.field("qacc"), engine.field("actuator_force")
    scatter(engine)
    data = kinematics(engine, 0)
    engine.step(3)
    data = mujoco.MjData(model)
    fresh = engine_of(model, 1)
    scatter(fresh)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (fresh.field(f)[0].numpy() for f in ("qpos", "qvel", "ctrl"))
    mujoco.mj_step(model, data, 3)
    np.testing.assert_array_equal(qacc[0], data.qacc)
    np.testing.assert_array_equal(force[0], data.actuator_force)


def test_field_bound_late_matches_state():
    engine = engine_of(model_of(), N)
    qacc = engine.field("qacc")
    scatter(engine)
    engine.step(3)
    kept = qacc.clone()
    for name in ("xpos", "sensordata"):
        for i in range(N):
            np.testing.assert_allclose(engine.field(name)[i], getattr(kinematics(engine, i), name), atol=1e-9)
    assert torch.equal(qacc, kept), "a field bound before keeps the values of its substep"


def test_force_sensors_have_values_of_last_substep_until_reset():
    xml = XML.replace('<accelerometer name="acc" site="imu"/><gyro name="gyro" site="imu"/>', '<force site="hip"/>')
    xml = xml.replace('<joint name="hip_fl"', '<site name="hip"/><joint name="hip_fl"')
    model = model_of(xml)
    engine = engine_of(model, N)
    sensors = engine.field("sensordata")
    scatter(engine)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (engine.field(f)[1].numpy() for f in ("qpos", "qvel", "ctrl"))
    engine.step(3)
    mujoco.mj_step(model, data, 3)
    np.testing.assert_array_equal(sensors[1], data.sensordata)
    assert np.abs(kinematics(engine, 1).sensordata - data.sensordata).max() > 1e-3, "another one than the state's"
    engine.reset(selection_of(2))
    engine.forward(selection_of(2))
    np.testing.assert_allclose(sensors[2], kinematics(engine, 2).sensordata, atol=1e-9)
    np.testing.assert_array_equal(sensors[1], data.sensordata)


def test_load_state_dict_restores_substep_fields_bound_later():
    engine, fresh = engine_of(model_of(), N), engine_of(model_of(), N)
    engine.field("qacc")
    scatter(engine)
    engine.step(3)
    fresh.load_state_dict(engine.state_dict())
    assert torch.equal(fresh.field("qacc"), engine.field("qacc"))


def test_reset_restores_whole_state_of_selected_worlds():
    engine = engine_of(model_of(), N)
    engine.set_default_state(torch.arange(11, dtype=torch.float64) / 10, torch.full((10,), 0.5, dtype=torch.float64))
    engine.reset(selection_of(0))
    default = engine.state_dict()["state"][0]
    scatter(engine)
    engine.field("xfrc_applied")[:] = 3.0
    engine.step(5)
    kept = engine.state_dict()["state"]
    engine.reset(selection_of(0, 3))
    state = engine.state_dict()["state"]
    for i in range(N):
        assert torch.equal(state[i], default if i in (0, 3) else kept[i])
    assert engine.field("qpos")[3].tolist() == [k / 10 for k in range(11)]
    assert engine.field("qvel")[3].tolist() == [0.5] * 10
    assert not engine.field("xfrc_applied")[3].any()


def test_expanded_gravity_changes_dynamics():
    engine = engine_of(
        model_of(PENDULUM.replace("base", "ball").replace('<body name="ball">', '<body name="ball"><freejoint/>')), 3
    )
    gravity = torch.tensor([-9.81, -1.62, 0.0], dtype=torch.float64)
    engine.expand("opt.gravity")[:, 2] = gravity
    engine.step(10)
    t = 10 * engine.model.opt.timestep
    # only gravity acts: the root falls with v = g t
    assert engine.field("qvel")[:, 2].tolist() == pytest.approx((gravity * t).tolist(), abs=1e-12)


def test_expanded_mass_changes_dynamics():
    xml = '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="s" type="slide" axis="1 0 0"/>'
    xml += '<geom size="0.1" mass="1"/></body></worldbody><actuator><motor joint="s"/></actuator></mujoco>'
    engine = engine_of(model_of(xml), 3)
    engine.expand("body_mass")[:, 1] = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    engine.set_constants()
    engine.field("ctrl")[:] = 8.0
    engine.step(5)
    t = 5 * engine.model.opt.timestep
    assert engine.field("qvel")[:, 0].tolist() == pytest.approx([8 * t, 4 * t, 2 * t], rel=1e-9)


@pytest.mark.parametrize("threads", [1, 4])
def test_restored_engine_continues_bit_for_bit_with_any_thread_count(threads):
    model = model_of()
    engine = engine_of(model, N, engine_threads=2)
    derived = engine.field("xpos"), engine.field("qacc"), engine.field("sensordata")
    engine.expand("body_mass")[:, 1] = torch.linspace(2, 4, N, dtype=torch.float64)
    engine.set_constants()
    scatter(engine)
    engine.step(25)
    saved = engine.state_dict()
    at_save = [value.clone() for value in derived]
    engine.step(25)
    other = engine_of(model, N, engine_threads=threads)
    restored = other.field("xpos"), other.field("qacc"), other.field("sensordata")
    other.load_state_dict(saved)
    for value, expected in zip(restored, at_save, strict=True):
        assert torch.equal(value, expected), "values that a policy observes"
    other.step(25)
    assert torch.equal(other.state_dict()["state"], engine.state_dict()["state"])
    assert torch.equal(other.expand("body_mass"), engine.expand("body_mass"))


def test_state_dict_is_copy():
    engine = engine_of(model_of(), N)
    saved = engine.state_dict()
    kept = saved["state"].clone()
    engine.step(2)
    assert torch.equal(saved["state"], kept)


def test_world_returns_one_world_without_changing_engine():
    engine = engine_of(model_of(), N)
    engine.expand("body_mass")[3, 1] = 9.0
    scatter(engine)
    engine.step(5)
    before = engine.state_dict()["state"]
    model, data = engine.world(3)
    np.testing.assert_array_equal(data.qpos, engine.field("qpos")[3])
    assert model.body_mass[1] == 9.0
    assert engine.model.body_mass[1] == 3.0
    np.testing.assert_allclose(data.xpos, kinematics(engine, 3).xpos, atol=1e-12)
    engine.step(1)
    again = engine.world(3)
    assert again[0] is model
    assert again[1] is data
    np.testing.assert_array_equal(data.qpos, engine.field("qpos")[3])
    assert not torch.equal(before, engine.state_dict()["state"])


def test_unknown_field_error_suggests_name():
    engine = engine_of(model_of(), 1)
    with pytest.raises(ValueError, match=r"'qvle' is not an MjData field; did you mean .*'qvel'"):
        engine.field("qvle")
    with pytest.raises(
        ValueError, match=r"'body_masss' cannot differ between environments; did you mean .*'body_mass'"
    ):
        engine.expand("body_masss")


@pytest.mark.parametrize("device", ["cuda:99", "tpu", "mps"])
def test_missing_device_raises_device_error(device):
    with pytest.raises(DeviceError, match=f"device '{device}' is not available"):
        engine_of(model_of(), 1, device=device)


def test_batch_engine_on_gpu_device_is_refused():
    with pytest.raises(ConfigError, match="'batch' runs on a CPU, not on 'cuda'"):
        engine_of(model_of(), 1, device="cuda", engine="batch")


def test_full_contact_buffer_is_counted_and_no_divergence():
    engine = engine_of(model_of(), 2)
    engine.step(1)
    engine._batch.warning[1, int(mujoco.mjtWarning.mjWARN_CONTACTFULL), 1] = 1
    assert engine.diverged() is None
    assert engine.warnings["contact_full"] == 1
    assert engine.diverged() is None
    assert engine.warnings["contact_full"] == 1


def test_sim_data_copies_qpos_and_qvel_at_once():
    engine = engine_of(model_of(), N)
    scatter(engine)
    sim = SimData(engine)
    assert sim.qpos.untyped_storage().data_ptr() == sim.qvel.untyped_storage().data_ptr(), "both are views of one copy"
    engine.field("qpos")[2, 0], engine.field("qvel")[N - 1, 9] = 7.0, -3.0
    sim.refresh()
    for name, copied in (("qpos", sim.qpos), ("qvel", sim.qvel)):
        assert torch.equal(copied, engine.field(name).float()), name
    before = sim.qvel.clone()
    engine.field("qvel")[:] = 5.0
    sim.refresh_rows(selection_of(1, 4))
    assert torch.equal(sim.qvel[[1, 4]], torch.full((2, 10), 5.0))
    assert torch.equal(sim.qvel[[0, 2, 3, 5]], before[[0, 2, 3, 5]])


@pytest.mark.parametrize("name", ["qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied"])
def test_state_field_is_view_of_integration_state(name):
    engine = engine_of(model_of(), N)
    field = engine.field(name)
    field.copy_(torch.arange(field.numel(), dtype=torch.float64).view(field.shape))
    for world in range(N):
        data = mujoco.MjData(engine.model)
        mujoco.mj_setState(engine.model, data, engine.state_row(world), int(mujoco.mjtState.mjSTATE_INTEGRATION))
        assert np.array_equal(getattr(data, name), field[world].numpy()), world
