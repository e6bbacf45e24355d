"""`velocity_point` of an entity: the point of each body whose velocity terms read and events set."""

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER, CRITTER_TASK, build, edited, write

OFF = '<inertial pos="0.05 0.02 -0.03" mass="3" diaginertia="0.02 0.05 0.06"/>'
XML = CRITTER.replace('<freejoint name="root"/>', f'<freejoint name="root"/>{OFF}')
KINDS = {"origin": mujoco.mjtObj.mjOBJ_XBODY, "com": mujoco.mjtObj.mjOBJ_BODY}
EVENTS = {
    "joints": None,
    "push": None,
    "shove": None,
    "com": {
        "func": "randomize_body_com",
        "mode": "startup",
        "bodies": "torso",
        "operation": "add",
        "range": [-0.1, 0.1],
    },
}


def critter(folder, point, engine="batch", randomised=False, init=None, dt=0.005):
    robot = {
        "model": "critter.xml",
        "velocity_point": point,
        "joints": {".*": {"kp": 20.0}},
        "init": {"joint_pos": {".*": 0.1}, **(init or {})},
    }
    events = EVENTS if randomised else {**EVENTS, "com": None}
    rewards = {"acc": {"func": "body_lin_acc_l2", "weight": 1.0}}
    task = edited(CRITTER_TASK, scene={"entities": {"robot": robot}}, events=events, rewards=rewards)
    return build(write(folder / "critter", task, critter_xml=XML), 4, f"sim.engine={engine}", f"sim.dt={dt}")


def set_random_state(env):
    generator = torch.Generator().manual_seed(1)
    qvel = env.engine.field("qvel")
    qvel[:] = torch.randn(qvel.shape, generator=generator).to(qvel.dtype)
    env.engine.forward(env._select_all())
    env.sim.refresh()


def expected(env, point):
    """Return the velocities of the bodies in each environment, from plain MuJoCo. (num_envs, bodies, 3)"""
    robot, ipos = env.entities["robot"], env.engine.expanded("body_ipos")
    rows = []
    for i in range(env.num_envs):
        model = env.engine.model.__copy__()
        if ipos is not None:
            model.body_ipos[:] = ipos[i].reshape(-1, 3).cpu().numpy()
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = (env.engine.field(n)[i].cpu().numpy() for n in ("qpos", "qvel"))
        mujoco.mj_forward(model, data)
        found = np.zeros((len(robot.body_ids), 6))
        for row, body in zip(found, robot.body_ids, strict=True):
            mujoco.mj_objectVelocity(model, data, KINDS[point], int(body), row, 0)
        rows.append(found[:, 3:])
    return torch.tensor(np.array(rows), dtype=torch.float32)


@pytest.mark.parametrize("engine", ["batch", pytest.param("warp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("randomised", [False, True], ids=["fixed", "randomised"])
@pytest.mark.parametrize("point", KINDS)
def test_velocities_are_those_of_the_point(tmp_path, point, randomised, engine):
    env = critter(tmp_path, point, engine, randomised)
    env.reset()
    set_random_state(env)
    data, close = env.entities["robot"].data, {"atol": 1e-4, "rtol": 1e-4}
    bodies = torch.tensor([0, 2])
    wanted = expected(env, point)
    torch.testing.assert_close(data.root_lin_vel_w, wanted[:, 0], **close)
    torch.testing.assert_close(data.body_lin_vel_w, wanted, **close)
    torch.testing.assert_close(data.body_lin_vel_of(bodies), wanted[:, bodies], **close)
    torch.testing.assert_close(data.body_states_of(bodies)[2], wanted[:, bodies], **close)
    for other in KINDS:
        torch.testing.assert_close(data.body_lin_vel_of(bodies, other), expected(env, other)[:, bodies], **close)
    torch.testing.assert_close(data.root_com_lin_vel_w, expected(env, "com")[:, 0], **close)
    torch.testing.assert_close(data.root_origin_lin_vel_w, expected(env, "origin")[:, 0], **close)


@pytest.mark.parametrize("point", KINDS)
def test_velocity_that_is_written_is_read_again(tmp_path, point):
    env = critter(tmp_path, point, randomised=True)
    env.reset()
    robot, some = env.entities["robot"], env._select(torch.tensor([True, False, True, True]))
    linear, angular = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(2)).unbind()
    robot.write_root_velocity(some, linear, angular)
    for found, wanted in zip(robot.read_root_velocity(some), (linear, angular), strict=True):
        torch.testing.assert_close(found, wanted)
    env.engine.forward(env._select_all())
    env.sim.refresh()
    torch.testing.assert_close(expected(env, point)[[0, 2, 3], 0], linear, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("point", KINDS)
def test_initial_velocity_is_that_of_the_point(tmp_path, point):
    env = critter(tmp_path, point, init={"lin_vel": [0.1, 0.2, 0.3], "ang_vel": [1.0, -2.0, 3.0]})
    torch.testing.assert_close(expected(env, point)[:, 0], torch.tensor([[0.1, 0.2, 0.3]] * 4))


@pytest.mark.parametrize("point", KINDS)
def test_acceleration_is_the_change_of_the_velocity(tmp_path, point):
    env = critter(tmp_path, point, dt=0.0001)
    env.reset()
    env.engine.field("qpos")[:, 2] = 2.0  # in the air
    set_random_state(env)
    before = expected(env, point)
    env.engine.step(1)
    env.sim.refresh()
    change = (expected(env, point) - before) / env.config.sim.dt
    torch.testing.assert_close(env.entities["robot"].data.body_lin_acc_w, change, atol=0.6, rtol=0.05)
