"""Every randomisation term: the values that it writes, in which environment, and their effect on physics."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import ENGINES, actions, build, dump, write

from rlcli.errors import ConfigError
from rlcli.scene.model_fields import DERIVED_FROM, FIELDS

MACHINE = """
<mujoco model="machine">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom name="post" type="box" size="0.1 0.1 0.1" pos="5 0 0.1"/>
    <body name="ball" pos="0 0 1"><freejoint/>
      <geom name="shell" type="sphere" size="0.1" mass="2" friction="0.7 0.02 0.003"/>
      <site name="eye" pos="0.05 0 0"/></body>
    <body name="arm" pos="2 0 1">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1" damping="0.4" armature="0.05" frictionloss="0.02"
        stiffness="3"/>
      <geom name="rod" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.4" mass="1" contype="0" conaffinity="0"/>
      <body name="hand" pos="0 0 -0.4"><joint name="wrist" axis="0 1 0" range="-2 2" damping="0.1"/>
        <geom name="palm" type="box" size="0.04 0.03 0.02" mass="0.3" contype="0" conaffinity="0"/></body>
    </body>
    <body name="cart" pos="-2 0 0.5"><joint name="slide" type="slide" axis="1 0 0"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" mass="1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <contact><pair name="touch" geom1="shell" geom2="post" friction="0.9 0.9 0.01 0.001 0.001"/></contact>
  <tendon><fixed name="cable" stiffness="5" damping="0.3" frictionloss="0.04" armature="0.01">
    <joint joint="shoulder" coef="1"/><joint joint="wrist" coef="-1"/></fixed></tendon>
  <actuator>
    <position name="servo" joint="shoulder" kp="50" kv="2" forcerange="-20 20"/>
    <velocity name="spin" joint="wrist" kv="4"/>
    <motor name="push" joint="slide" gear="10" forcerange="-3 3"/>
  </actuator>
</mujoco>
"""
TASK = {
    "decimation": 2,
    "episode_length_s": 0.1,
    "sim": {"dt": 0.005},
    "scene": {"num_envs": 6, "entities": {"robot": {"model": "machine.xml", "soft_joint_pos_limit_factor": 0.9}}},
    "actions": {"push": {"func": "joint_effort", "joints": ["slide"]}},
    "observations": {"policy": {"pos": {"func": "joint_pos"}, "gravity": {"func": "projected_gravity"}}},
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}


def machine(tmp_path, num_envs=6, *overrides, engine="batch", seed=42, **events):
    task = write(tmp_path / "machine", dump({**TASK, "events": events}), machine_xml=MACHINE)
    return build(task, num_envs, f"sim.engine={engine}", *overrides, seed=seed)


def models(env):
    """Return each environment's own MjModel."""
    made = []
    for i in range(env.num_envs):
        model = env.world(i)[0]
        made.append({name: np.array(value_of(model, name)) for name in FIELDS} | {"sub": model.body_subtreemass.copy()})
    return made


def value_of(model, name):
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def row(env, field, name):
    """Return the row of a field that belongs to the element `name`, and its original value."""
    kind = FIELDS[field]
    model = env.engine.model
    lookup = {"Bodies": model.body, "Joints": model.joint, "Geoms": model.geom, "Sites": model.site,
              "Actuators": model.actuator, "Tendons": model.tendon, "Pairs": model.pair}  # fmt: skip
    if not kind:
        return 0, np.atleast_2d(value_of(model, field))
    element = lookup[kind](f"robot/{name}")
    index = int(element.dofadr[0]) if field.startswith("dof_") else element.id
    return index, np.array(value_of(model, field))


U = [0.5, 1.5]
# term, its parameters, the element, the field, axes, operation
TABLE = [
    ("randomize_body_mass", {"bodies": "hand"}, "hand", "body_mass", [0], "scale"),
    ("randomize_body_com", {"bodies": "hand"}, "hand", "body_ipos", [0, 1, 2], "add"),
    ("randomize_body_inertia", {"bodies": "hand"}, "hand", "body_inertia", [0, 1, 2], "scale"),
    ("randomize_body_pos", {"bodies": "hand", "axes": [0, 2]}, "hand", "body_pos", [0, 2], "add"),
    ("randomize_geom_friction", {"geoms": "shell"}, "shell", "geom_friction", [0], "scale"),
    ("randomize_geom_friction", {"geoms": "shell", "axes": [1, 2]}, "shell", "geom_friction", [1, 2], "scale"),
    ("randomize_geom_size", {"geoms": "palm"}, "palm", "geom_size", [0, 1, 2], "scale"),
    ("randomize_geom_pos", {"geoms": "palm", "axes": [1]}, "palm", "geom_pos", [1], "add"),
    ("randomize_site_pos", {"sites": "eye"}, "eye", "site_pos", [0, 1, 2], "add"),
    ("randomize_joint_damping", {"joints": "shoulder"}, "shoulder", "dof_damping", [0], "scale"),
    ("randomize_joint_armature", {"joints": "shoulder"}, "shoulder", "dof_armature", [0], "scale"),
    ("randomize_joint_friction_loss", {"joints": "shoulder"}, "shoulder", "dof_frictionloss", [0], "scale"),
    ("randomize_joint_stiffness", {"joints": "shoulder"}, "shoulder", "jnt_stiffness", [0], "scale"),
    ("randomize_gravity", {}, "", "opt.gravity", [2], "add"),
    ("randomize_tendon_stiffness", {"tendons": "cable"}, "cable", "tendon_stiffness", [0], "scale"),
    ("randomize_tendon_damping", {"tendons": "cable"}, "cable", "tendon_damping", [0], "scale"),
    ("randomize_tendon_friction_loss", {"tendons": "cable"}, "cable", "tendon_frictionloss", [0], "scale"),
    ("randomize_tendon_armature", {"tendons": "cable"}, "cable", "tendon_armature", [0], "scale"),
    ("randomize_pair_friction", {"pairs": "touch"}, "touch", "pair_friction", [0, 1], "scale"),
    ("randomize_model_field", {"field": "jnt_margin", "names": "wrist", "operation": "set"}, "wrist", "jnt_margin",
     [0], "set"),
    ("randomize_model_field", {"field": "geom_solref", "names": "shell", "axes": [1]}, "shell", "geom_solref", [1],
     "scale"),
]  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("term", "params", "element", "field", "axes", "operation"), TABLE)
def test_values_differ_between_envs_around_original(tmp_path, engine, term, params, element, field, axes, operation):
    env = machine(tmp_path, engine=engine, it={"func": term, "mode": "startup", "range": U, **params})
    index, original = row(env, field, element)
    original = original.reshape(len(original), -1)
    found = np.stack([m[field].reshape(len(original), -1) for m in models(env)])
    start = original[index, axes]
    drawn = {"add": found[:, index, axes] - start, "set": found[:, index, axes]}
    if operation == "scale":
        drawn["scale"] = found[:, index, axes] / start
    assert (drawn[operation] >= U[0] - 1e-6).all()
    assert (drawn[operation] <= U[1] + 1e-6).all()
    assert len(np.unique(drawn[operation][:, 0].round(5))) == env.num_envs, "every environment its own"
    touched = np.zeros_like(original, dtype=bool)
    touched[index, axes] = True
    assert np.allclose(found[:, ~touched], original[~touched], rtol=1e-6, atol=1e-9), "nothing else is changed"


@pytest.mark.parametrize("engine", ENGINES)
def test_mass_scales_inertia_and_derived_constants(tmp_path, engine):
    events = {"it": {"func": "randomize_body_mass", "mode": "startup", "bodies": ["hand", "ball"], "range": U}}
    env = machine(tmp_path, engine=engine, **events)
    before = env.engine.model
    hand, arm = before.body("robot/hand").id, before.body("robot/arm").id
    for i in range(env.num_envs):
        model = env.world(i)[0]
        factor = model.body_mass[hand] / before.body_mass[hand]
        assert model.body_inertia[hand] == pytest.approx(before.body_inertia[hand] * factor, rel=1e-5)
        assert model.body_subtreemass[arm] == pytest.approx(1.0 + 0.3 * factor, rel=1e-5)
        fresh = build(tmp_path / "machine", 1).world(0)[0]
        fresh.body_mass[:], fresh.body_inertia[:] = model.body_mass, model.body_inertia
        mujoco.mj_setConst(fresh, mujoco.MjData(fresh))
        assert model.dof_invweight0 == pytest.approx(fresh.dof_invweight0, rel=1e-3)
        chain = slice(1, hand + 1)  # MuJoCo Warp weighs the rotation of a body that only slides differently
        assert model.body_invweight0[chain] == pytest.approx(fresh.body_invweight0[chain], rel=1e-3)


def test_mass_without_inertia(tmp_path):
    env = machine(tmp_path, it={"func": "randomize_body_mass", "mode": "startup", "range": [2.0, 2.0],
                                "bodies": "hand", "with_inertia": False})  # fmt: skip
    hand = env.engine.model.body("robot/hand").id
    assert env.world(0)[0].body_mass[hand] == pytest.approx(0.6)
    assert (env.world(0)[0].body_inertia[hand] == env.engine.model.body_inertia[hand]).all()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("term", "kind", "element", "field"),
    [
        ("randomize_body_quat", "bodies", "hand", "body_quat"),
        ("randomize_geom_quat", "geoms", "palm", "geom_quat"),
        ("randomize_site_quat", "sites", "eye", "site_quat"),
    ],
)
def test_orientations_turn_about_own_axes(tmp_path, engine, term, kind, element, field):
    env = machine(tmp_path, engine=engine, it={"func": term, "mode": "startup", kind: element, "yaw": [0.2, 0.8]})
    index, original = row(env, field, element)
    turned = []
    for model in models(env):
        inverse, turn = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(inverse, original[index])
        mujoco.mju_mulQuat(turn, inverse, model[field][index].astype(np.float64))
        assert turn[1:3] == pytest.approx([0.0, 0.0], abs=1e-6)
        turned.append(2 * math.atan2(turn[3], turn[0]))
    assert min(turned) >= 0.2 - 1e-6
    assert max(turned) <= 0.8 + 1e-6
    assert len(set(turned)) == env.num_envs


def test_body_com_of_free_body_matches_compiled_model(tmp_path):
    env = machine(tmp_path, 2, it={"func": "randomize_body_com", "mode": "startup", "bodies": "ball",
                                   "range": [[0.03, 0.03], [0.02, 0.02], [0.0, 0.0]]})  # fmt: skip
    qvel = env.engine.field("qvel")
    env.reset()
    start = env.entities["robot"].root_dof
    qvel[:, start + 3 : start + 6] = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    written = MACHINE.replace('size="0.1" mass="2"', 'size="0.1" mass="0"').replace(
        '<site name="eye"', '<inertial pos="0.03 0.02 0" mass="2" diaginertia="0.008 0.008 0.008"/><site name="eye"'
    )
    alone = mujoco.MjModel.from_xml_string(written)
    alone.opt.timestep = 0.005
    data = mujoco.MjData(alone)
    data.qvel[3:6] = [1.0, 2.0, 3.0]
    mujoco.mj_step(alone, data, 20)
    env.engine.step(20)
    root = env.entities["robot"].root_qpos
    assert env.engine.field("qpos")[0, root : root + 7].tolist() == pytest.approx(data.qpos[:7].tolist(), abs=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_actuator_gains_keep_actuator_kind(tmp_path, engine):
    events = {
        "servo": {"func": "randomize_actuator_gains", "mode": "startup", "actuators": "servo", "kp": U, "kv": U},
        "spin": {"func": "randomize_actuator_gains", "mode": "startup", "actuators": "spin", "kv": [2.0, 3.0]},
    }
    env = machine(tmp_path, engine=engine, **events)
    servo, spin = (env.engine.model.actuator(f"robot/{name}").id for name in ("servo", "spin"))
    kps = set()
    for m in models(env):
        kp, (b0, b1, b2) = m["actuator_gainprm"][servo, 0], m["actuator_biasprm"][servo, :3]
        assert 25 <= kp <= 75
        assert b0 == 0
        assert b1 == -kp
        assert 1 <= -b2 <= 3
        kv = m["actuator_gainprm"][spin, 0]
        assert 8 <= kv <= 12
        assert m["actuator_biasprm"][spin, :3].tolist() == [0, 0, -kv]
        kps.add(float(kp))
    assert len(kps) == env.num_envs


@pytest.mark.parametrize("engine", ENGINES)
def test_pd_gains_differ_between_envs(tmp_path, engine):
    models = "{soft: {joints: [wrist], stiffness: 20.0, damping: 0.0, effort_limit: 100.0}}"
    env = machine(
        tmp_path,
        6,
        f"scene.entities.robot.actuators={models}",
        "actions={turn: {func: joint_position, joints: [wrist]}}",
        engine=engine,
        it={"func": "randomize_pd_gains", "mode": "startup", "joints": "wrist", "stiffness": U, "effort_limit": U},
    )
    env.reset()
    env.step(torch.full((6, 1), 0.001))
    (model,) = env.entities["robot"].actuators
    gains = model.stiffness[:, 0]
    assert (gains >= 10.0).all()
    assert (gains <= 30.0).all()
    assert len(set(gains.tolist())) == 6
    assert len(set(model.effort_limit[:, 0].tolist())) == 6
    env.engine.field("qpos")[:, int(env.engine.model.joint("robot/wrist").qposadr[0])] = 0.0
    model.compute()
    assert model.applied_effort[:, 0].tolist() == pytest.approx((0.001 * gains).tolist(), rel=1e-4)


@pytest.mark.parametrize("engine", ENGINES)
def test_effort_limit_accounts_for_gear(tmp_path, engine):
    env = machine(
        tmp_path,
        engine=engine,
        it={
            "func": "randomize_effort_limit",
            "mode": "startup",
            "actuators": ["push"],
            "operation": "set",
            "range": [4.0, 8.0],
        },
    )
    env.reset()
    env.engine.field("ctrl")[:, env.engine.model.actuator("robot/push").id] = 1000.0
    env.engine.step(1)
    env.sim.refresh()
    column = env.entities["robot"].joint_names.index("slide")
    force = env.entities["robot"].data.applied_effort[:, column]
    assert (force >= 4.0 - 1e-5).all()
    assert (force <= 8.0 + 1e-5).all()
    assert len(set(force.tolist())) == env.num_envs


@pytest.mark.parametrize("engine", ENGINES)
def test_joint_range_changes_limits_in_terms(tmp_path, engine):
    env = machine(tmp_path, engine=engine, it={"func": "randomize_joint_range", "mode": "startup", "joints": "shoulder",
                                               "upper": [-0.5, 0.5]},
                  reset={"func": "reset_joints_by_offset", "mode": "reset", "position": [9.0, 9.0]})  # fmt: skip
    env.reset()
    data = env.entities["robot"].data
    uppers = [float(m["jnt_range"][env.engine.model.joint("robot/shoulder").id, 1]) for m in models(env)]
    assert len(set(uppers)) == env.num_envs
    _, high = data.joint_limits()
    column = env.entities["robot"].joint_names.index("shoulder")
    assert high[:, column].tolist() == pytest.approx(uppers, rel=1e-6)
    soft = [0.5 * (u - 1.5) + 0.45 * (u + 1.5) for u in uppers]  # 0.9 of the range from -1.5 to u, around its middle
    assert data.joint_limits(soft=True)[1][:, column].tolist() == pytest.approx(soft, rel=1e-5)
    assert data.joint_pos[:, column].tolist() == pytest.approx(soft, rel=1e-5), "the reset stops there"


@pytest.mark.parametrize("engine", ENGINES)
def test_default_joint_pos_changes_resets_and_observations(tmp_path, engine):
    env = machine(
        tmp_path,
        6,
        "observations.policy.pos={func: joint_pos_rel}",
        engine=engine,
        it={"func": "randomize_default_joint_pos", "mode": "startup", "joints": ["wrist"], "range": [0.1, 0.3]},
        reset={"func": "reset_joints_by_offset", "mode": "reset"},
    )
    obs = env.reset()["policy"]
    wrist = env.entities["robot"].data.joint_pos[:, env.entities["robot"].joint_names.index("wrist")]
    assert (wrist >= 0.1).all()
    assert (wrist <= 0.3).all()
    assert len(set(wrist.tolist())) == env.num_envs
    assert obs[:, :3].abs().max() == 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_gravity_changes_projected_gravity(tmp_path, engine):
    env = machine(
        tmp_path,
        engine=engine,
        it={
            "func": "randomize_gravity",
            "mode": "reset",
            "axes": [0, 1, 2],
            "operation": "set",
            "range": [[1.0, 3.0], [0.0, 0.0], [-4.0, -2.0]],
        },
    )
    obs = env.reset()["policy"][:, -3:]
    for i, m in enumerate(models(env)):
        g = m["opt.gravity"]
        assert obs[i].tolist() == pytest.approx((g / np.linalg.norm(g)).tolist(), abs=1e-6)
    assert len({round(float(o[0]), 5) for o in obs}) == env.num_envs


DISTRIBUTIONS = [
    ("uniform", [2.0, 6.0], lambda x: (x.min() >= 2, x.max() <= 6, abs(x.mean() - 4) < 0.15)),
    ("loguniform", [0.1, 10.0], lambda x: (x.min() >= 0.1, x.max() <= 10.0001, abs(np.log(x).mean()) < 0.2)),
    ("gaussian", [5.0, 0.5], lambda x: (abs(x.mean() - 5) < 0.1, abs(x.std() - 0.5) < 0.05, x.min() < 4.2)),
]


@pytest.mark.parametrize(("distribution", "range_", "holds"), DISTRIBUTIONS, ids=[d[0] for d in DISTRIBUTIONS])
def test_distribution_has_expected_shape(tmp_path, distribution, range_, holds):
    env = machine(tmp_path, 800, it={"func": "randomize_joint_damping", "mode": "startup", "operation": "set",
                                     "joints": "shoulder", "distribution": distribution, "range": range_})  # fmt: skip
    drawn = env.engine.expand("dof_damping")[:, row(env, "dof_damping", "shoulder")[0]].numpy()
    assert all(holds(drawn)), (drawn.mean(), drawn.std())


def test_values_are_clipped_to_lower_bound(tmp_path):
    env = machine(tmp_path, it={"func": "randomize_joint_damping", "mode": "startup", "operation": "add",
                                "range": [-9.0, -8.0]})  # fmt: skip
    assert set(env.engine.expand("dof_damping")[:, 6:].flatten().tolist()) == {0.0}


def test_shared_gives_all_elements_one_draw(tmp_path):
    both = {"func": "randomize_joint_damping", "mode": "startup", "joints": ["shoulder", "wrist"], "operation": "set"}
    env = machine(tmp_path, shared={**both, "range": U, "shared": True})
    assert torch.equal(*env.engine.expand("dof_damping")[:, 6:8].unbind(1))
    env = machine(tmp_path, own={**both, "range": U})
    left, right = env.engine.expand("dof_damping")[:, 6:8].unbind(1)
    assert not (left == right).any()


@pytest.mark.parametrize("operation", ["add", "scale"])
def test_repeated_draws_do_not_accumulate(tmp_path, operation):
    env = machine(tmp_path, it={"func": "randomize_joint_damping", "mode": "reset", "joints": "shoulder",
                                "operation": operation, "range": [1.5, 2.0]})  # fmt: skip
    damping = env.engine.expand("dof_damping")[:, 6]
    low, high = {"add": (1.9, 2.4), "scale": (0.6, 0.8)}[operation]
    seen = set()
    for _ in range(20):
        env.reset()
        assert (damping >= low - 1e-6).all()
        assert (damping <= high + 1e-6).all()
        seen |= set(damping.tolist())
    assert len(seen) == 20 * env.num_envs


def test_draws_independent_of_num_envs_and_other_events(tmp_path):
    it = {"func": "randomize_body_mass", "mode": "startup", "range": U, "distribution": "loguniform"}
    other = {"func": "randomize_joint_damping", "mode": "startup", "range": U}
    few = machine(tmp_path / "a", 3, it=it).engine.expand("body_mass")
    many = machine(tmp_path / "b", 37, other=other, it=it, late=other).engine.expand("body_mass")
    assert torch.equal(few, many[:3])


@pytest.mark.warp
def test_engines_draw_the_same(tmp_path):
    it = {"func": "randomize_body_mass", "mode": "startup", "range": U, "distribution": "loguniform"}
    host, device = (machine(tmp_path / e, it=it, engine=e).engine.expand("body_mass") for e in ("batch", "warp"))
    torch.testing.assert_close(host.float(), device, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_state_dict_restores_randomized_values(tmp_path, engine):
    events = {
        "mass": {"func": "randomize_body_mass", "mode": "startup", "range": U},
        "pose": {"func": "randomize_default_joint_pos", "mode": "startup", "joints": "wrist", "range": [-0.2, 0.2]},
        "friction": {
            "func": "randomize_geom_friction",
            "mode": "reset",
            "range": U,
            "geoms": "shell",
            "min_steps_between": 15,
        },
        "gravity": {
            "func": "randomize_gravity",
            "mode": "interval",
            "interval_range_s": [0.02, 0.06],
            "range": [-1.0, 1.0],
            "global_time": True,
        },
        "reset": {"func": "reset_joints_by_offset", "mode": "reset", "position": [-0.1, 0.1]},
    }
    env = machine(tmp_path, 4, engine=engine, **events)
    env.reset()
    steps = actions(40 if engine == "batch" else 22, 4, 1)  # Warp's CPU device is slow; the 20th step resets
    for action in steps[:13]:
        env.step(action)
    fresh = machine(tmp_path, 4, engine=engine, seed=1, **events)
    fresh.load_state_dict(env.state_dict())
    for action in steps[13:]:
        left, right = env.step(action), fresh.step(action)
        for name in ("body_mass", "geom_friction", "opt.gravity", "dof_invweight0"):
            assert torch.equal(env.engine.expand(name), fresh.engine.expand(name)), name
        if engine == "batch":
            assert torch.equal(left.obs["policy"], right.obs["policy"])
    assert torch.equal(env.entities["robot"].data.default_joint_pos, fresh.entities["robot"].data.default_joint_pos)


# --- effects on physics, compared with formulas ---

FALL = {"decimation": 1, "sim": {"dt": 0.002, "integrator": "implicitfast"}, "episode_length_s": 100.0}
WORLD = """
<mujoco><option cone="{cone}" impratio="100"/><compiler angle="radian"/>
  <worldbody>
    <body name="block" pos="0 0 0.0999"><freejoint/>
      <geom name="sole" type="box" size="0.2 0.2 0.1" mass="1" friction="0.4" solref="0.004 1"/></body>
    <body name="bob" pos="5 0 3"><joint name="swing" axis="0 1 0"/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/></body>
    <body name="cart" pos="9 0 2"><joint name="slide" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
  </worldbody>
  <actuator><motor name="push" joint="slide"/></actuator>
</mujoco>
"""


def physical(tmp_path, cone="elliptic", engine="batch", n=5, dt=0.002, **events):
    sim = {**FALL["sim"], "dt": dt}
    task = {
        **TASK,
        **FALL,
        "sim": sim,
        "events": events,
        "actions": {"push": {"func": "joint_effort", "joints": ["slide"]}},
    }
    task["scene"] = {"entities": {"robot": {"model": "world.xml"}}}
    env = build(write(tmp_path / "physical", dump(task), world_xml=WORLD.format(cone=cone)), n, f"sim.engine={engine}")
    env.reset()
    return env


@pytest.mark.parametrize("engine", ENGINES)
def test_free_fall_uses_gravity_of_env(tmp_path, engine):
    steps, dt = 12, 0.01
    gravity = {"func": "randomize_gravity", "mode": "startup", "range": [-3.0, 8.0]}
    env = physical(tmp_path, engine=engine, dt=dt, it=gravity)
    g = -env.engine.expand("opt.gravity")[:, 2].double()
    assert len(set(g.tolist())) == 5
    env.engine.field("qpos")[:, 2] = 50.0
    env.engine.step(steps)
    fallen = 50.0 - env.engine.field("qpos")[:, 2].double()
    t = steps * dt
    assert fallen.tolist() == pytest.approx((0.5 * g * t * (t + dt)).tolist(), rel=1e-3)  # semi-implicit Euler


@pytest.mark.parametrize("engine", ENGINES)
def test_force_accelerates_mass_of_env(tmp_path, engine):
    scale = {"func": "randomize_body_mass", "mode": "startup", "bodies": "cart", "range": [0.5, 4.0]}
    env = physical(tmp_path, engine=engine, dt=0.01, it=scale)
    mass = env.engine.expand("body_mass")[:, env.engine.model.body("robot/cart").id].double()
    assert len(set(mass.tolist())) == 5
    env.engine.field("ctrl")[:, 0] = 2.0
    env.engine.step(10)
    velocity = env.engine.field("qvel")[:, int(env.engine.model.joint("robot/slide").dofadr[0])].double()
    assert velocity.tolist() == pytest.approx((2.0 * 0.1 / mass).tolist(), rel=1e-4)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_sliding_distance_matches_friction(tmp_path, cone):
    env = physical(tmp_path, cone, it={"func": "randomize_geom_friction", "mode": "startup", "geoms": "sole",
                                       "range": [0.2, 0.6], "operation": "set"})  # fmt: skip
    mu = env.engine.expand("geom_friction")[:, env.engine.model.geom("robot/sole").id, 0]
    assert len(set(mu.tolist())) == 5
    assert (mu < 1.0).all(), "lower than the ground's, and still it holds"
    env.engine.step(100)
    start = env.engine.field("qpos")[:, 0].clone()
    env.engine.field("qvel")[:, :6] = torch.tensor([1.0, 0, 0, 0, 0, 0], dtype=torch.float64)
    env.engine.step(400)
    slid = env.engine.field("qpos")[:, 0] - start
    assert slid.tolist() == pytest.approx((1.0 / (2.0 * mu * 9.81)).tolist(), rel=0.04)


def test_pendulum_period_matches_gravity(tmp_path):
    env = physical(tmp_path, it={"func": "randomize_gravity", "mode": "startup", "operation": "scale",
                                                "range": [0.3, 2.0]})  # fmt: skip
    g = -env.engine.expand("opt.gravity")[:, 2].double()
    joint = env.engine.model.joint("robot/swing")
    angle = env.engine.field("qpos")[:, int(joint.qposadr[0])]
    angle[:] = 0.02
    history = []
    for _ in range(500):
        env.engine.step(2)
        history.append(angle.double().clone())
    path = torch.stack(history)
    for i in range(5):
        down = ((path[:-1, i] > 0) & (path[1:, i] <= 0)).nonzero()[0]
        k = int(down[0])
        quarter = (k + 1 + float(path[k, i] / (path[k, i] - path[k + 1, i]))) * 0.004
        assert 4 * quarter == pytest.approx(2 * math.pi / math.sqrt(float(g[i])), rel=3e-3)


# --- errors when the environment is built ---

BAD = [
    ({"func": "randomize_model_field", "field": "geom_type", "range": U}, "'geom_type' cannot differ"),
    ({"func": "randomize_model_field", "field": "body_mas", "range": U}, "did you mean 'body_mass'"),
    ({"func": "randomize_body_mass", "bodies": "hnd", "range": U}, "no body matches 'hnd'"),
    ({"func": "randomize_body_mass", "range": [2.0, 1.0]}, "lower end 2 is above the upper end 1"),
    ({"func": "randomize_body_mass", "range": [0.0, 1.0], "distribution": "loguniform"}, "loguniform needs"),
    ({"func": "randomize_body_mass", "range": [1.0, -1.0], "distribution": "gaussian"}, "deviation -1 is negative"),
    ({"func": "randomize_body_com", "range": [U, U]}, "2 pairs for 3 axes"),
    ({"func": "randomize_geom_friction", "axes": [3], "range": U}, "geom_friction has no axis 3"),
    ({"func": "randomize_joint_range", "joints": "slide", "upper": U}, "joints without limits: slide"),
    ({"func": "randomize_actuator_gains", "actuators": ["push", "servo"], "kp": U}, "actuators without kp: push"),
    ({"func": "randomize_actuator_gains"}, "no gain is given"),
    ({"func": "randomize_pd_gains", "stiffness": U}, "joints without an actuator model: "),
    ({"func": "randomize_effort_limit", "actuators": "spin", "range": U}, "actuators without an effort limit: spin"),
    ({"func": "randomize_pair_friction", "pairs": "none", "range": U}, "no pair matches 'none'"),
    ({"func": "reset_joints_within_limits", "joints": ["slide"]}, "joints without limits: slide"),
]


@pytest.mark.parametrize(("event", "message"), BAD, ids=[message for _, message in BAD])
def test_invalid_randomization_error_lists_alternatives(tmp_path, event, message):
    with pytest.raises(ConfigError) as error:
        machine(tmp_path, it={"mode": "startup", **event})
    (problem,) = error.value.problems
    assert message in f"{problem.message}; {problem.hint}"
    assert "events.it" in problem.path
    assert problem.where.partition(":")[0].endswith("task.yaml")
    if "geom_type" in message:
        assert "body_mass" in problem.hint


def test_derived_from_covers_mujoco_setconst_inputs():
    inputs = set(mujoco.MjModel._setconst_inputs)
    assert {name for name in FIELDS if name in inputs} <= DERIVED_FROM
