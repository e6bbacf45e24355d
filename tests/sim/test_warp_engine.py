"""Tests of the GPU engine on Warp's CPU device: agreement with the CPU engine, selections, divergence."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER, PENDULUM_TASK, build, critter, edited, pendulum

from rlcli.config.schema import SimConfig
from rlcli.errors import ConfigError, DivergedError
from rlcli.sim.engine import open_engine
from rlcli.sim.state_cache import SimData

torch.set_num_threads(1)

N = 5
XML = CRITTER.replace("<worldbody>", '<worldbody><geom type="plane" size="5 5 1"/>').replace(
    "</mujoco>",
    "<actuator>" + "".join(f'<position joint="hip_{s}" kp="20" kv="0.5"/>' for s in ("fl", "fr", "bl", "br"))
    + "</actuator></mujoco>",
)  # fmt: skip
FIELDS = ("xpos", "xquat", "site_xpos", "cvel", "sensordata", "qacc", "actuator_force", "qfrc_actuator")


def pair(xml=XML, fields=(), **settings):
    model = mujoco.MjModel.from_xml_string(xml)
    dt = model.opt.timestep
    engines = [open_engine(model, N, SimConfig(dt=dt, engine=kind, **settings)) for kind in ("batch", "warp")]
    for engine in engines:
        for name in fields:
            engine.field(name)
    return engines


def scatter(engine, height=0.0):
    """Set different states and controls in every world, equal on all engines."""
    random = np.random.default_rng(0)

    def draw(*shape):
        return torch.from_numpy(random.uniform(-1, 1, shape))

    def put(name, values):
        engine.field(name).copy_(values)

    qpos = torch.from_numpy(np.repeat(engine.model.qpos0[None], N, axis=0))
    qpos[:, :3] += 0.1 * draw(N, 3)
    qpos[:, 2] += height
    qpos[:, 7:] += 0.3 * draw(N, 4)
    put("qpos", qpos)
    put("qvel", draw(N, 10))
    put("ctrl", draw(N, 4))


def selection_of(engine, *ids):
    mask = torch.tensor([i in ids for i in range(N)])
    return engine.select(mask, 0, torch.zeros(N, dtype=torch.int64))


def assert_equal(host, device, names, tolerance, where=""):
    for name in names:
        expected, found = host.field(name).double(), device.field(name).double()
        assert found.shape[0] == N
        scale = max(1.0, float(expected.abs().max()))
        error = float((expected - found.view(expected.shape)).abs().max()) / scale
        assert error < tolerance, f"{where} {name}: {error:.1e}"


def snapshot(engine, names):
    return {name: engine.field(name).clone() for name in names}


def assert_rows(before, after, rows):
    for name, values in before.items():
        assert torch.equal(values[rows], after[name][rows]), name


# --- fields ---


@pytest.mark.parametrize("forces", [True, False])
def test_derived_fields_agree_with_cpu_after_step_and_partial_reset(forces):
    host, device = pair(fields=FIELDS, forces_after_reset=forces)
    for engine in (host, device):
        scatter(engine, height=0.5)
        engine.step(3)
    assert_equal(host, device, ("qpos", "qvel", *FIELDS), 2e-5, "after a step")
    rest, kept = [0, 2, 3], snapshot(device, ("qpos", "qvel", "time", *FIELDS))
    for engine in (host, device):
        chosen = selection_of(engine, 1, 4)
        engine.reset(chosen)
        engine.field("qpos")[4, 2] = 0.25  # on its feet, in contact with the ground
        engine.field("ctrl")[4] = 0.3
        engine.forward(chosen)
    assert_equal(host, device, ("qpos", "qvel", *FIELDS), 2e-5, "after a reset")
    assert_rows(kept, snapshot(device, kept), rest)
    forces_of_start = device.field("actuator_force")[[1, 4]], device.field("qacc")[[1, 4]]
    assert forces_of_start[0].any() == forces
    assert forces_of_start[1].any() == forces
    accelerometer, _ = device.field("sensordata").split(3, dim=1)
    assert (float(accelerometer[4].abs().max()) > 5.0) == forces
    for engine in (host, device):
        engine.step(2)
    assert_equal(host, device, ("qpos", "qvel"), 1e-3, "and on")


@pytest.mark.parametrize("name", FIELDS)
def test_field_bound_late_matches_state(name):
    host, device = pair()
    for engine in (host, device):
        scatter(engine, height=0.5)
    assert_equal(host, device, [name], 2e-5)


def test_field_is_live_and_unknown_field_error_suggests_name():
    _, device = pair()
    qpos = device.field("qpos")
    assert device.field("qpos").data_ptr() == qpos.data_ptr()
    device.step(1)
    assert not torch.equal(qpos, torch.from_numpy(device.model.qpos0).float().expand(N, -1))
    with pytest.raises(ValueError, match="qpos"):
        device.field("qpso")
    with pytest.raises(ValueError, match="body_mass"):
        device.expand("body_mas")


# --- resets ---


def test_partial_reset_changes_only_selected_worlds():
    _, device = pair(fields=("xpos", "xfrc_applied"))
    names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "time", "xfrc_applied", "xpos")
    scatter(device)
    device.field("xfrc_applied")[:] = 0.1
    device.step(5)
    kept = snapshot(device, names)
    device.set_default_state(torch.from_numpy(device.model.qpos0) + 0.01, torch.full((10,), 0.5))
    device.reset(selection_of(device, 0, 3))
    device.forward(selection_of(device, 0, 3))
    now = snapshot(device, names)
    assert_rows(kept, now, [1, 2, 4])
    for name in ("qacc_warmstart", "ctrl", "time", "xfrc_applied"):
        assert kept[name][[0, 3]].any()
        assert not now[name][[0, 3]].any(), name
    torch.testing.assert_close(now["qpos"][[0, 3]], (torch.from_numpy(device.model.qpos0) + 0.01).float().expand(2, -1))
    assert (now["qvel"][[0, 3]] == 0.5).all()


def test_worlds_without_reset_continue_unchanged():
    engines = [pair()[1] for _ in range(2)]
    for engine in engines:
        scatter(engine)
        engine.step(4)
    engines[1].reset(selection_of(engines[1], 2))
    engines[1].forward(selection_of(engines[1], 2))
    for engine in engines:
        engine.step(4)
    here, there = (snapshot(engine, ("qpos", "qvel")) for engine in engines)
    assert_rows(here, there, [0, 1, 3, 4])
    assert not torch.equal(here["qpos"][2], there["qpos"][2])


MOCAP = """
<mujoco><worldbody>
  <body name="hand" mocap="true" pos="1 2 3"><geom size="0.1" contype="0" conaffinity="0"/></body>
  <body name="ball" pos="1 2 2"><freejoint/><geom size="0.1"/></body>
</worldbody><equality><weld body1="hand" body2="ball"/></equality></mujoco>
"""


def test_reset_restores_mocap_poses_and_equalities():
    for engine in pair(MOCAP):
        position, turn, active = (engine.field(name) for name in ("mocap_pos", "mocap_quat", "eq_active"))
        before = [values.clone() for values in (position, turn, active)]
        position += 1.0
        turn.copy_(torch.tensor([0.0, 1.0, 0.0, 0.0]))
        active[:] = False
        engine.reset(selection_of(engine, 1))
        for values, old in zip((position, turn, active), before, strict=True):
            assert torch.equal(values[1], old[1])
            assert not torch.equal(values[0], old[0])


# --- model fields of a world ---


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("body_mass", lambda values: values[2].mul_(3.0)),
        ("dof_damping", lambda values: values[2].add_(2.0)),
        ("opt.gravity", lambda values: values[2].mul_(0.2)),
    ],
)
def test_expanded_field_changes_dynamics_of_one_world(name, change):
    host, device = pair()
    _, plain = pair()
    for engine in (host, device, plain):
        scatter(engine, height=0.3)
    for engine in (host, device):
        values = engine.expand(name)
        assert values.shape[0] == N
        change(values)
        engine.set_constants()
    for engine in (host, device, plain):
        engine.step(4)
    assert_equal(host, device, ("qpos", "qvel"), 1e-4)
    rest = [0, 1, 3, 4]
    torch.testing.assert_close(device.field("qvel")[rest], plain.field("qvel")[rest], rtol=1e-5, atol=1e-5)
    assert float((device.field("qvel")[2] - plain.field("qvel")[2]).abs().max()) > 1e-3


def test_set_constants_follows_written_mass():
    host, device = pair()
    for engine in (host, device):
        engine.expand("body_mass")[1:] *= torch.arange(2.0, 6.0)[:, None]
        engine.set_constants()
    for name in ("body_subtreemass", "dof_invweight0", "body_invweight0"):
        expected, found = host.expand(name).double(), device.expand(name).double()
        torch.testing.assert_close(found.view(expected.shape), expected, rtol=1e-4, atol=1e-6)
        assert not torch.equal(found[0], found[1])


def test_world_returns_state_and_model_of_one_world():
    _, device = pair(fields=("xfrc_applied",))
    scatter(device)
    device.expand("body_mass")[3, 1] = 7.0
    device.expand("opt.gravity")[3] = torch.tensor([0.0, 0.0, -1.0])
    device.field("xfrc_applied")[3, 1] = 0.5
    device.step(2)
    before = snapshot(device, ("qpos", "qvel", "ctrl"))
    model, data = device.world(3)
    for name in ("qpos", "qvel", "ctrl", "xfrc_applied"):
        np.testing.assert_array_equal(getattr(data, name).astype(np.float32), device.field(name)[3].numpy())
    assert data.time == pytest.approx(2 * model.opt.timestep)
    assert model.body_mass[1] == 7.0
    assert model.opt.gravity[2] == -1.0
    np.testing.assert_allclose(data.xpos[1], data.qpos[:3], err_msg="forwarded")
    other, _ = device.world(0)
    assert other.body_mass[1] == 3.0
    assert device.model.body_mass[1] == 3.0
    assert device.world(3)[1] is data
    assert_rows(before, snapshot(device, before), list(range(N)))


def test_restored_engine_continues_equally():
    first, second = pair(fields=("qacc", "sensordata"))[1], pair()[1]
    scatter(first)
    first.expand("body_mass")[1] *= 1.5
    first.field("xfrc_applied")[2, 1, 0] = 3.0
    first.step(7)
    saved = first.state_dict()
    kept = {name: values.clone() for name, values in saved.items()}
    first.step(3)
    assert all(torch.equal(values, kept[name]) for name, values in saved.items()), "state_dict returns copies"
    second.load_state_dict(saved)
    assert torch.equal(second.field("qacc"), saved["substep.qacc"])
    second.step(3)
    names = ("qpos", "qvel", "time", "ctrl", "qacc", "sensordata", "xfrc_applied")
    assert_rows(snapshot(first, names), snapshot(second, names), list(range(N)))
    assert torch.equal(second.expand("body_mass"), first.expand("body_mass"))


@pytest.mark.parametrize("task", ["critter", "cartpole-direct"])
def test_restored_environment_continues_equally(tmp_path, task):
    place = critter(tmp_path) if task == "critter" else task
    first, second = (build(place, 4, "sim.engine=warp", "episode_length_s=0.3") for _ in range(2))
    action = torch.full((4, first.layout.action_size), 0.2)
    first.reset()
    for _ in range(7):
        obs = first.step(action).obs
    loaded = second.load_state_dict(first.state_dict())
    assert all(torch.equal(obs[group], loaded[group]) for group in obs)
    for _ in range(12):  # through resets
        here, there = first.step(action), second.step(action)
        assert torch.equal(here.reward, there.reward)
        assert torch.equal(here.truncated, there.truncated)
        assert all(torch.equal(here.obs[group], there.obs[group]) for group in here.obs)
    assert int(first.episode_index.min()) >= 1


# --- divergence ---


@pytest.mark.parametrize(
    ("field", "value", "world"), [("qpos", math.nan, 0), ("qvel", math.inf, 3), ("qvel", 1e12, 3), ("qpos", 1e12, 4)]
)
def test_diverged_world_is_terminated_and_restored_alone(tmp_path, field, value, world):
    sound, sick = (build(critter(tmp_path), N, "sim.engine=warp", "episode_length_s=9.0") for _ in range(2))
    action = torch.full((N, 4), 0.2)
    for env in (sound, sick):
        env.reset()
        for _ in range(3):
            env.step(action)
    last = sick.sim.qpos[world].clone(), sick.sim.qvel[world].clone()
    sick.engine.field(field)[world, -1] = value
    rest = [i for i in range(N) if i != world]
    for i in range(8):
        here, there = sound.step(action), sick.step(action)
        if i == 0:
            assert there.terminated.tolist() == [env == world for env in range(N)]
            assert not there.truncated.any()
            episodes = there.episodes.ended()
            assert episodes.ids.tolist() == [world]
            assert episodes.causes["diverged"].tolist() == [True]
            assert torch.equal(there.final_obs["critic"][world], torch.cat([last[0][7:], last[1][6:]]))
        for group, values in here.obs.items():
            assert torch.equal(values[rest], there.obs[group][rest])
            assert there.obs[group].isfinite().all()
        assert torch.equal(here.reward[rest], there.reward[rest])
        assert there.reward.isfinite().all(), "terms that read forces and derived fields are finite too"
    assert sick.divergences == 1
    sick.check()


@pytest.mark.parametrize("engine", ["batch", "warp"])
def test_world_beyond_max_velocity_diverges_with_reward_of_last_state(tmp_path, engine):
    quick, slow = (
        build(critter(tmp_path), N, f"sim.engine={engine}", f"sim.max_velocity={most}", "episode_length_s=9.0")
        for most in ("null", 40.0)
    )
    action = torch.full((N, 4), 0.2)
    for env in (quick, slow):
        env.reset()
        for _ in range(3):
            assert not env.step(action).terminated.any()
        last = env.sim.qpos[1].clone(), env.sim.qvel[1].clone()
        env.engine.field("qvel")[1, 0] = -400.0  # the root, along x
    assert not quick.step(action).terminated.any()
    result = slow.step(action)
    assert result.terminated.tolist() == [env == 1 for env in range(N)]
    assert result.episodes.ended().causes["diverged"].tolist() == [True]
    assert torch.equal(result.final_obs["critic"][1], torch.cat([last[0][7:], last[1][6:]]))
    assert float(result.reward.abs().max()) < 10.0
    assert slow.engine.divergence_causes == {"qvel out of bounds": 1}
    assert "root" in slow.engine.described_divergences[0].detail
    assert not slow.step(action).terminated.any()


def test_divergence_in_first_step_uses_start_state(tmp_path):
    envs = [build(pendulum(tmp_path), 3, f"sim.engine={engine}") for engine in ("batch", "warp")]
    for env in envs:
        env.reset()
        for _ in range(10):  # the time-out starts new episodes at rest
            result = env.step(torch.full((3, 1), 5.0))
        assert result.truncated.all()
        env.engine.field("qvel")[1, 0] = math.nan
        result = env.step(torch.zeros(3, 1))
        assert result.terminated.tolist() == [False, True, False]
        assert result.final_obs["policy"][1].tolist() == [0.0, 0.0]


def test_repeated_divergence_is_counted(tmp_path):
    env = build(pendulum(tmp_path), 3, "sim.engine=warp")
    env.reset()
    for count in (1, 2, 3):
        env.engine.field("qpos")[1, 0] = math.nan
        assert env.step(torch.zeros(3, 1)).terminated.tolist() == [False, True, False]
        assert env.divergences == count
        assert not env.step(torch.zeros(3, 1)).terminated.any()
    env.check()


BROKEN = '''
from rlcli.task import Entity


def broken(env, *, entity: Entity = "robot"):
    """(num_envs,)"""
    return 1.0 / (entity.data.joint_pos[:, 0] - 1.0).round()


def broken_row(env, *, entity: Entity = "robot"):
    """(num_envs, 1)"""
    return 1.0 / (entity.data.joint_pos - 1.0).round()
'''


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"rewards": {"bad": {"func": "broken", "weight": 1.0}}}, "the reward is not finite"),
        ({"observations": {"policy": {"odd": {"func": "broken_row"}}}}, "observation group 'policy' is not finite"),
    ],
)
def test_check_reports_nonfinite_values_by_name_once(tmp_path, changes, named):
    task = pendulum(tmp_path, edited(PENDULUM_TASK, episode_length_s=5.0, **changes), terms_py=BROKEN)
    env = build(task, 3, "sim.engine=warp")
    env.reset()
    env.step(torch.zeros(3, 1))
    env.check()
    env.engine.field("qpos")[2, 0] = 1.0
    env.step(torch.zeros(3, 1))
    with pytest.raises(DivergedError, match=named):
        env.check()
    env.engine.field("qpos")[2, 0] = 0.0
    env.engine.field("qvel")[2, 0] = 0.0
    env.step(torch.zeros(3, 1))
    env.check()


@pytest.mark.parametrize("task", ["pendulum", "cartpole-direct"])
@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_check_reports_nonfinite_action(tmp_path, task, value):
    env = build(pendulum(tmp_path) if task == "pendulum" else task, 3, "sim.engine=warp")
    env.reset()
    env.step(torch.tensor([[0.0], [value], [0.0]]))
    with pytest.raises(DivergedError, match="the policy's action is not finite"):
        env.check()


def test_check_finite_accepts_any_number_of_names():
    _, device = pair()
    for i in range(40):
        device.check_finite(torch.full((N, 2), math.nan if i in (3, 20, 39) else 0.0), f"thing {i}")
    assert device.report_nonfinite() == ["thing 3", "thing 20", "thing 39"]
    assert device.report_nonfinite() == []
    device.check_finite(torch.full((N,), math.nan), "thing 20")
    assert device.report_nonfinite() == ["thing 20"]


# --- unsupported models ---


def test_unsupported_solver_is_refused_with_hint():
    xml = XML.replace("<worldbody>", '<option solver="PGS"/><worldbody>', 1)
    model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(ConfigError) as refused:
        open_engine(model, 2, SimConfig(dt=0.002, engine="warp"))
    assert "PGS" in str(refused.value)
    assert "--device cpu" in str(refused.value)
    open_engine(model, 2, SimConfig(dt=0.002, engine="batch")).step(1)


def test_batch_engine_on_gpu_is_refused_first():
    with pytest.raises(ConfigError, match="batch"):
        open_engine(mujoco.MjModel.from_xml_string(XML), 2, SimConfig(dt=0.002, engine="batch"), device="cuda")


ONLY_MOTION = XML.replace(
    "</mujoco>",
    '<sensor><gyro site="imu"/><velocimeter site="imu"/><subtreecom body="torso"/>'
    '<subtreelinvel body="torso"/></sensor></mujoco>',
)


@pytest.mark.parametrize("also", [(), ("qfrc_bias",), ("actuator_velocity",)])
def test_motion_agrees_with_cpu_for_any_bound_fields(also):
    """Check fields that need neither contacts nor inertias, alone and with a bound field that needs them."""
    names = ("site_xpos", "cvel", "subtree_com", "sensordata", *also)
    host, device = pair(ONLY_MOTION, names)
    for engine in (host, device):
        scatter(engine, height=0.5)
        engine.step(3)
    assert_equal(host, device, names, 2e-5, "after a step")
    for engine in (host, device):
        chosen = selection_of(engine, 1, 3)
        engine.reset(chosen)
        engine.field("qvel")[1] = 0.5
        engine.forward(chosen)
    assert_equal(host, device, names, 2e-5, "after a reset")


@pytest.mark.parametrize("kind", [0, 1])
def test_forward_keeps_substep_forces_without_forces_after_reset(kind):
    names = ("actuator_force", "qacc", "sensordata")
    engine = pair(fields=names, forces_after_reset=False)[kind]
    scatter(engine)
    engine.step(2)
    felt = snapshot(engine, ("actuator_force", "qacc"))
    accelerations = engine.field("sensordata")[:, :3].clone()
    assert felt["actuator_force"][2].any()
    engine.field("qvel")[2, :3] += 1.0  # pushed, not reset
    engine.forward(selection_of(engine, 2))
    assert_rows(felt, snapshot(engine, felt), range(N))
    assert torch.equal(engine.field("sensordata")[:, :3], accelerations)
    engine.reset(selection_of(engine, 2))
    engine.forward(selection_of(engine, 2))
    assert not engine.field("actuator_force")[2].any()
    assert not engine.field("sensordata")[2, :3].any()
    assert torch.equal(engine.field("sensordata")[3, :3], accelerations[3])


def test_derived_fields_of_diverged_world_are_restored():
    names = ("xpos", "cvel", "sensordata")
    _, device = pair(fields=names)
    scatter(device, height=0.5)
    device.step(2)
    assert not device.diverged().any()
    before = snapshot(device, names)
    device.field("qvel")[3, 0] = torch.nan
    device.step(1)
    assert device.diverged().tolist() == [i == 3 for i in range(N)]
    now = snapshot(device, names)
    for name in names:
        torch.testing.assert_close(now[name][3], before[name][3], rtol=1e-5, atol=1e-5)
        assert not torch.equal(now[name][2], before[name][2]), name


@pytest.mark.parametrize("kind", [0, 1])
def test_derived_fields_follow_two_moves(kind):
    engine = pair(fields=("xpos",))[kind]
    sim = SimData(engine)
    for world, height in ((1, 2.0), (3, 3.0)):
        chosen = selection_of(engine, world)
        engine.field("qpos")[world, 2] = height
        sim.on_moved(chosen)
    sim.forward_moved()
    start = float(engine.model.qpos0[2])
    torch.testing.assert_close(sim.derived_field("xpos")[:, 1, 2], torch.tensor([start, 2.0, start, 3.0, start]))
    engine.field("qpos")[0, 2] = 4.0
    sim.on_moved(selection_of(engine, 0))
    assert float(sim.derived_field("xpos")[0, 1, 2]) == pytest.approx(4.0), "reading updates the derived fields"


HELD = """
<mujoco>
  <option integrator="implicitfast" solver="Newton"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="a" pos="0 0 1"><joint name="a" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
      <body name="b" pos="0.3 0 0"><joint name="b" axis="0 1 0"/><joint name="c" axis="0 0 1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/></body></body>
    <body name="free" pos="0.6 0 1"><freejoint/><geom size="0.05"/></body>
  </worldbody>
  <equality>{constraint}</equality>
</mujoco>
"""


@pytest.mark.parametrize(
    "constraint", ['<connect body1="b" body2="free" anchor="0.3 0 0"/>', '<weld body1="b" body2="free"/>']
)
@pytest.mark.parametrize("how", ["step", "forward"])
def test_equality_constraints_use_current_velocities(constraint, how):
    """Set other velocities, as a reset does: those of the step before must have no effect."""
    engines = pair(HELD.format(constraint=constraint), ["qacc"] if how == "forward" else [])
    speeds = 10.0 * torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (N, 9)))
    found = []
    for engine in engines:
        engine.field("qvel").copy_(-speeds)
        engine.step(1)
        engine.reset(selection_of(engine, *range(N)))
        engine.field("qvel").copy_(speeds)
        if how == "step":
            engine.step(1)
            found.append(engine.field("qvel").float())
        else:
            engine.forward(selection_of(engine, *range(N)))
            found.append(engine.field("qacc").float())
    torch.testing.assert_close(found[0], found[1], rtol=2e-4, atol=2e-4 * float(found[0].abs().max()))


def test_a_large_dense_model_runs_and_agrees():
    """More than 60 degrees of freedom with `jacobian="dense"`, for which MuJoCo Warp has only sparse matrices."""
    chain = "".join(
        f'<body pos="0 0 0.1"><joint axis="{i % 2} {1 - i % 2} 0" damping="0.1"/><geom size="0.03"/>' for i in range(62)
    )
    xml = (
        '<mujoco><option jacobian="dense" integrator="implicitfast"/><worldbody><geom type="plane" size="5 5 1"/>'
        f"<body>{chain}{'</body>' * 62}</body></worldbody></mujoco>"
    )
    batch, warp = pair(xml, ("xpos",))
    for engine in (batch, warp):
        engine.field("qvel")[:] = torch.linspace(-1, 1, 62, dtype=torch.float64)
        engine.step(5)
    assert batch.model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    torch.testing.assert_close(warp.field("xpos")[:].double(), batch.field("xpos")[:].double(), rtol=1e-3, atol=1e-4)
