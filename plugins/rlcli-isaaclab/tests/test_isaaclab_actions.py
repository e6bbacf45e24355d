# ruff: noqa: E501
"""Actions in Isaac Lab's form, and curricula: values of independent formulas on random states of plain MuJoCo."""

import math
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli_isaaclab import (
    ActionTerm,
    ActionTermCfg,
    ArticulationCfg,
    CommandTermCfg,
    CurrTerm,
    DoneTerm,
    EventTerm,
    ImplicitActuatorCfg,
    InteractiveSceneCfg,
    ManagerBasedRLEnvCfg,
    ObsGroup,
    ObsTerm,
    RewTerm,
    RigidObjectCfg,
    configclass,
    mdp,
    sim_utils,
)
from rlcli_isaaclab import SceneEntityCfg as Pick
from rlcli_isaaclab.command_terms import UniformPoseCommand
from rlcli_isaaclab.multirotor import Thruster
from rlcli_isaaclab.namespace import lab_name
from rlcli_isaaclab.runtime import facade_of
from rlcli_isaaclab.utils.noise import AdditiveUniformNoiseCfg

torch.set_num_threads(1)
ENVS, JOINTS = 8, 7
AXES = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "0 0 1", "0 1 0", "1 0 0")


def arm():
    """Return an MJCF with seven hinges on a fixed, turned base."""
    inner = '<body name="tool" pos="0 0 .1"><geom size=".03" pos=".02 0 .01" mass=".4"/></body>'
    for number in reversed(range(JOINTS)):
        inner = (
            f'<body name="link{number}" pos=".03 .02 .15"><joint name="j{number}" axis="{AXES[number]}" range="-2 2"'
            f' damping=".5" armature=".02"/><geom size=".04 .03 .06" type="box" pos=".01 .02 .05" mass="1"/>{inner}</body>'
        )
    tendon = '<tendon><fixed name="band" stiffness="3"><joint joint="j0" coef="1"/><joint joint="j1" coef="-1"/></fixed></tendon>'
    base = '<body name="base" quat=".9 .1 .2 .3"><geom size=".1"/>'
    return f'<mujoco><compiler angle="radian"/><worldbody>{base}{inner}</body></worldbody>{tendon}</mujoco>'


@configclass
class Policy(ObsGroup):
    position = ObsTerm(func=mdp.joint_pos, noise=AdditiveUniformNoiseCfg(n_min=-0.1, n_max=0.1))

    def __post_init__(self):
        self.enable_corruption = True


def task(folder, action, stiffness=0.0, decimation=1, **changes):
    """Return an environment with one action of the arm."""
    (folder / "arm.xml").write_text(arm())

    @configclass
    class SceneCfg(InteractiveSceneCfg):
        robot = ArticulationCfg(
            prim_path="R/Robot", spawn=sim_utils.UsdFileCfg(usd_path="arm.xml"), soft_joint_pos_limit_factor=0.5,
            init_state=ArticulationCfg.InitialStateCfg(joint_pos={"j.*": 0.1}, rot=(0.9, 0.1, 0.2, 0.3)),
            actuators={"all": ImplicitActuatorCfg(joint_names_expr=["j.*"], stiffness=stiffness, damping=0.5)},
        )  # fmt: skip

    @configclass
    class Cfg(ManagerBasedRLEnvCfg):
        scene: SceneCfg = SceneCfg(num_envs=ENVS, env_spacing=4.0)

        def __post_init__(self):
            self.decimation, self.episode_length_s, self.sim.dt = decimation, 5.0, 0.002
            self.actions = {"arm": action}
            self.observations = {"policy": Policy()}
            self.rewards = {"speed": RewTerm(func=mdp.joint_vel_l2, weight=-1.0)}
            self.terminations = {"time_out": DoneTerm(func=mdp.time_out, time_out=True)}
            for name, value in changes.items():
                setattr(self, name, value)

    env = make_env(resolve(source_of(Cfg(), folder)), seed=0)
    env.reset()
    return env


def randomized(env, seed=28):
    """Put every environment into a random state; return its states in plain MuJoCo."""
    draws, states = np.random.default_rng(seed), []
    model = env.engine.model
    qpos, qvel = draws.uniform(-1, 1, (ENVS, model.nq)), draws.normal(size=(ENVS, model.nv))
    env.engine.field("qpos")[:], env.engine.field("qvel")[:] = torch.tensor(qpos), torch.tensor(qvel)
    env.sim.on_moved(env._select_all())
    for row in range(ENVS):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
        mujoco.mj_forward(model, data)
        states.append(data)
    return model, states


def osc(**control):
    settings = lab_name("OperationalSpaceControllerCfg")(
        **{"target_types": ["pose_abs"], "motion_stiffness_task": 100.0, "nullspace_control": "position", **control}
    )
    return lab_name("OperationalSpaceControllerActionCfg")(
        asset_name="robot", joint_names=["j.*"], body_name="tool", controller_cfg=settings, stiffness_scale=50.0,
        nullspace_joint_pos_target="center",
    )  # fmt: skip


def expected_efforts(model, data, action, decoupled):
    """Return the efforts of operational space control: F = L (Kp e - Kd v), J^T F, and the null space."""
    base, tool = model.body("robot/base").id, model.body("robot/tool").id
    root, inertia = data.xmat[base].reshape(3, 3), np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, linear, angular, tool)
    jacobian = np.concatenate([root.T @ linear, root.T @ angular])
    centre = np.zeros((3, model.nv))
    mujoco.mj_jacBodyCom(model, data, centre, None, tool)
    velocity = np.concatenate([root.T @ centre @ data.qvel, root.T @ angular @ data.qvel])
    quat, back = np.zeros(4), np.zeros(4)
    mujoco.mju_mulQuat(quat, data.xquat[base] * [1, -1, -1, -1], data.xquat[tool])
    mujoco.mju_mulQuat(back, action[3:7], quat * [1, -1, -1, -1])
    back = -back if back[0] < 0 else back
    half = math.atan2(np.linalg.norm(back[1:]), back[0])
    error = np.concatenate(
        [action[:3] - root.T @ (data.xpos[tool] - data.xpos[base]), back[1:] * 2 * half / math.sin(half)]
    )
    gains = (50.0 * action[7:13]).clip(20.0, 200.0)
    force = gains * error - 2.0 * np.sqrt(gains) * velocity
    inverse = np.linalg.inv(inertia)
    if decoupled:
        operational = np.linalg.inv(jacobian @ inverse @ jacobian.T)
        force, pseudo = operational @ force, operational @ jacobian @ inverse
    else:
        pseudo = np.linalg.pinv(jacobian).T
    rest = inertia @ (10.0 * (0.0 - data.qpos) - 2.0 * math.sqrt(10.0) * data.qvel)
    return jacobian.T @ force + (np.eye(model.nv) - jacobian.T @ pseudo) @ rest


@pytest.mark.parametrize("decoupled", [False, True])
def test_operational_space_control_equals_its_formula(tmp_path, decoupled):
    limits = {"motion_stiffness_limits_task": (20.0, 200.0), "impedance_mode": "variable_kp"}
    env = task(tmp_path, osc(inertial_dynamics_decoupling=decoupled, **limits))
    term = env.action_manager.terms[0].instance
    assert term.size == 13
    model, states = randomized(env)
    action = torch.rand(ENVS, 13, generator=torch.Generator().manual_seed(3))
    term.process(action)
    term.apply()
    controls = env.engine.field("ctrl").numpy()
    wanted = [expected_efforts(model, d, a, decoupled) for d, a in zip(states, action.numpy(), strict=True)]
    np.testing.assert_allclose(controls, wanted, rtol=2e-3, atol=2e-3)


def test_inertia_and_gravity_of_the_joints_are_those_of_mujoco(tmp_path):
    env = task(tmp_path, osc())
    model, states = randomized(env)
    view = facade_of(env).scene["robot"].root_physx_view
    matrices, gravity = view.get_generalized_mass_matrices().numpy(), view.get_gravity_compensation_forces().numpy()
    for row, data in enumerate(states):
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        np.testing.assert_allclose(matrices[row], inertia, rtol=1e-4, atol=1e-5)
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(gravity[row], data.qfrc_bias, rtol=1e-4, atol=1e-4)


def test_poses_of_centres_of_mass(tmp_path):
    env = task(tmp_path, osc())
    model, states = randomized(env)
    data, bodies = facade_of(env).scene["robot"].data, env.entities["robot"].body_ids
    np.testing.assert_allclose(data.body_com_pos_w, [d.xipos[bodies] for d in states], atol=1e-5)
    inside = np.broadcast_to(model.body_ipos[bodies], data.body_com_pos_b.shape)
    np.testing.assert_allclose(data.body_com_pos_b, inside, atol=1e-5)
    axes = [np.abs([mujoco_quat(m) for m in d.ximat[bodies]]) for d in states]
    np.testing.assert_allclose(data.body_com_quat_w.abs(), axes, atol=1e-4)
    assert torch.equal(data.root_com_pose_w, data.body_com_pose_w[:, 0])
    assert data.root_com_state_w.shape == (ENVS, 13)


def mujoco_quat(matrix):
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, matrix)
    return found


def test_relative_position_adds_to_the_position_of_each_physics_step(tmp_path):
    action = mdp.RelativeJointPositionActionCfg(asset_name="robot", joint_names=["j.*"], scale=0.5)
    env = task(tmp_path, action, stiffness=30.0, decimation=3)
    model, states = randomized(env)
    raw = torch.rand(ENVS, JOINTS, generator=torch.Generator().manual_seed(5)) * 2.0 - 1.0
    env.step(raw)
    for row, data in enumerate(states):
        for _ in range(3):
            data.ctrl[:] = data.qpos + 0.5 * raw[row].numpy()
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(env.engine.field("qpos")[row], data.qpos, atol=1e-5)


def test_binary_velocity_opens_and_closes(tmp_path):
    action = mdp.BinaryJointVelocityActionCfg(
        asset_name="robot", joint_names=["j5", "j6"], open_command_expr={"j5": 1.0, "j6": 2.0},
        close_command_expr={"j.": -3.0},
    )  # fmt: skip
    env = task(tmp_path, action)
    env.action_manager.process(torch.tensor([[0.5], [-0.5]] * (ENVS // 2)))
    assert env.engine.field("ctrl").tolist() == [[1.0, 2.0], [-3.0, -3.0]] * (ENVS // 2)


class Spring(ActionTerm):
    """Pulls every joint to a target, by code of the task that runs before each physics step."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self._raw = torch.zeros(self.num_envs, JOINTS, device=self.device)

    action_dim = JOINTS

    @property
    def raw_actions(self):
        return self._raw

    processed_actions = raw_actions

    def process_actions(self, actions):
        self._raw[:] = actions

    def apply_actions(self):
        efforts = self.cfg.gain * (self._raw - self._asset.data.joint_pos)
        self._asset.set_joint_effort_target(efforts)


@configclass
class SpringCfg(ActionTermCfg):
    class_type: type = Spring
    gain: float = 4.0


def test_own_action_reads_the_state_of_each_physics_step(tmp_path):
    env = task(tmp_path, SpringCfg(asset_name="robot"), decimation=3)
    model, states = randomized(env)
    raw = torch.rand(ENVS, JOINTS, generator=torch.Generator().manual_seed(7))
    env.step(raw)
    for row, data in enumerate(states):
        for _ in range(3):
            data.ctrl[:] = 4.0 * (raw[row].numpy() - data.qpos)
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(env.engine.field("qpos")[row], data.qpos, atol=1e-5)


def test_state_of_an_own_action_is_saved(tmp_path):
    env = task(tmp_path, SpringCfg(asset_name="robot"))
    env.step(torch.ones(ENVS, JOINTS))
    state = env.state_dict()
    env.step(torch.zeros(ENVS, JOINTS))
    env.load_state_dict(state)
    assert env.action_manager.terms[0].instance.term.raw_actions.tolist() == [[1.0] * JOINTS] * ENVS


# --- ten terms drawn with random.seed(280028) from those that test_isaaclab_values.py does not cover ---


def called(env, name, *picks, **params):
    return getattr(mdp, name)(facade_of(env), *picks, **params)


def test_drawn_frame_quaternion(tmp_path):
    env = task(tmp_path, osc())
    _, states = randomized(env)
    data = facade_of(env).scene["robot"].data
    found = data.body_quat_w[:, -1]
    tool = env.engine.model.body("robot/tool").id
    np.testing.assert_allclose(found, [d.xquat[tool] for d in states], atol=1e-5)


def test_drawn_joint_acceleration_penalty(tmp_path):
    env = task(tmp_path, osc(), rewards={"a": RewTerm(func=mdp.joint_acceleration_penalty, weight=1.0)})
    model, states = randomized(env)
    reward = env.step(torch.zeros(ENVS, 7)).reward
    controls = env.engine.field("ctrl").numpy()
    for row, data in enumerate(states):
        data.ctrl[:] = controls[row]
        mujoco.mj_step(model, data)
        assert reward[row].item() == pytest.approx(0.002 * np.linalg.norm(data.qacc), rel=1e-3)


def test_drawn_clamped_squares_of_the_action(tmp_path):
    terms = {
        name: RewTerm(func=getattr(mdp, name), weight=1.0) for name in ("action_l2_clamped", "action_rate_l2_clamped")
    }
    action = mdp.JointEffortActionCfg(asset_name="robot", joint_names=["j.*"], scale=0.001)
    env = task(tmp_path, action, rewards=terms)
    first, second = torch.full((ENVS, JOINTS), 3.0), torch.full((ENVS, JOINTS), -20.0)
    reward = env.step(first).reward
    assert reward.tolist() == pytest.approx([0.002 * (63.0 + 63.0)] * ENVS)
    reward = env.step(second).reward
    assert reward.tolist() == pytest.approx([0.002 * (1000.0 + 1000.0)] * ENVS)


def test_drawn_reset_within_limits(tmp_path):
    params = {"position_range": {"j[0-5]": [-0.5, 0.25], "j6": [0.1, 0.1]}, "velocity_range": {"j0": [2.0, 3.0]},
              "use_default_offset": True, "operation": "abs"}  # fmt: skip
    event = EventTerm(func=mdp.reset_joints_within_limits_range, mode="reset", params=params)
    env = task(tmp_path, osc(), events={"reset": event})
    position, velocity = env.entities["robot"].data.joint_pos, env.entities["robot"].data.joint_vel
    assert position[:, 6].tolist() == pytest.approx([0.2] * ENVS)
    assert bool(((position[:, :6] >= 0.1 - 0.5) & (position[:, :6] <= 0.1 + 0.25)).all())
    assert float(position[:, :6].std()) > 0.1
    assert bool(((velocity[:, 0] >= 2.0) & (velocity[:, 0] <= 3.0)).all())


def test_drawn_tendon_stiffness(tmp_path):
    params = {"asset_cfg": Pick("robot", fixed_tendon_names=["band"]), "stiffness_distribution_params": (2.0, 4.0),
              "operation": "scale"}  # fmt: skip
    event = EventTerm(func=mdp.randomize_fixed_tendon_parameters, mode="startup", params=params)
    env = task(tmp_path, osc(), events={"band": event})
    found = env.engine.expanded("tendon_stiffness")
    found = found.reshape(ENVS, -1)[:, 0]
    assert bool(((found >= 6.0) & (found <= 12.0)).all())
    assert float(found.std()) > 0.3


def test_drawn_external_force(tmp_path):
    params = {"force_range": (2.0, 2.0), "torque_range": (-1.0, -1.0), "asset_cfg": Pick("robot", body_names="tool")}
    event = EventTerm(func=mdp.apply_external_force_torque, mode="reset", params=params)
    env = task(tmp_path, osc(), events={"push": event})
    tool = env.engine.model.body("robot/tool").id
    assert env.engine.field("xfrc_applied")[:, tool].tolist() == [[2.0] * 3 + [-1.0] * 3] * ENVS
    notes = {note.key: note.status for note in env.resolved.notes}
    assert notes["events.push.func"] == "approximated"  # Isaac Lab's force turns with the body


# --- thrusters ---


def rotor_settings(**changes):
    cfg = {"dt": 0.01, "thrust_range": (0.1, 10.0), "max_thrust_rate": 500.0, "thrust_const_range": (1e-5, 2e-5),
           "tau_inc_range": (0.05, 0.08), "tau_dec_range": (0.005, 0.006), "use_discrete_approximation": True,
           "integration_scheme": "rk4"}  # fmt: skip
    return SimpleNamespace(**{**cfg, **changes})


@pytest.mark.parametrize("scheme", ["rk4", "euler"])
def test_thruster_equals_its_scalar_formula(scheme):
    torch.manual_seed(9)
    group = Thruster(rotor_settings(integration_scheme=scheme), ["a", "b"], [0, 1], 3, "cpu", torch.full((3, 2), 200.0))
    assert torch.allclose(group.curr_thrust, group.thrust_const * 200.0**2)
    thrust = group.curr_thrust.double().numpy().copy()
    for target in (6.0, 0.0, 20.0, 3.0):
        found = group.compute(torch.full((3, 2), target))
        for at in np.ndindex(3, 2):
            wanted, constant = min(max(target, 0.1), 10.0), float(group.thrust_const[at])
            tau = float((group.tau_dec_s if wanted < thrust[at] else group.tau_inc_s)[at])
            speed, goal = math.sqrt(thrust[at] / constant), math.sqrt(wanted / constant)

            def rate(error, tau=tau):
                return min(max(error / (0.01 + tau), -500.0), 500.0)

            k1 = rate(goal - speed)
            k2 = rate(goal - speed + 0.005 * k1)
            k3 = rate(goal - speed + 0.005 * k2)
            k4 = rate(goal - speed + 0.01 * k3)
            speed += 0.01 * k1 if scheme == "euler" else 0.01 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            thrust[at] = constant * speed**2
        np.testing.assert_allclose(found, thrust.clip(0.1, 10.0), rtol=1e-4)


PROPS = ["p1", "p2", "p3", "p4"]
ALLOCATION = [
    [0.0] * 4,
    [0.0] * 4,
    [1.0] * 4,
    [-0.1, -0.1, 0.1, 0.1],
    [-0.1, 0.1, 0.1, -0.1],
    [-0.07, 0.07, -0.07, 0.07],
]
DRONE = "<mujoco><worldbody><body name='hull'><freejoint/><geom size='.1 .1 .02' type='box' mass='1'/>{}</body></worldbody></mujoco>"


def test_multirotor_forces_act_in_the_frame_of_the_body(tmp_path):
    parts = "".join(
        f"<body name='{name}' pos='{i} 0 0'><geom size='.01' mass='.01'/></body>" for i, name in enumerate(PROPS)
    )
    (tmp_path / "drone.xml").write_text(DRONE.format(parts))
    kind = lab_name("MultirotorCfg")
    rotors = lab_name("ThrusterCfg")(thruster_names_expr=["p."], torque_to_thrust_ratio=0.07, **vars(rotor_settings()))

    @configclass
    class SceneCfg(InteractiveSceneCfg):
        robot = kind(
            prim_path="R/Robot", spawn=sim_utils.UsdFileCfg(usd_path="drone.xml"), actuators={"thrusters": rotors},
            init_state=kind.InitialStateCfg(pos=(0, 0, 1), rot=(0.9, 0.1, 0.2, 0.3), rps={"p.": 300.0}),
            allocation_matrix=ALLOCATION, rotor_directions=[1, -1, 1, -1],
        )  # fmt: skip

    action = lab_name("ThrustActionCfg")(
        asset_name="robot", scale=3.0, offset=3.0, use_default_offset=False, clip={"p[12]": (0.0, 4.0)}
    )
    observed = ObsGroup()
    vars(observed)["pos"] = ObsTerm(func=mdp.root_pos_w)

    @configclass
    class Cfg(ManagerBasedRLEnvCfg):
        scene: SceneCfg = SceneCfg(num_envs=2, env_spacing=4.0)

        def __post_init__(self):
            self.decimation, self.episode_length_s, self.sim.dt = 2, 5.0, 0.01
            self.actions, self.observations = {"thrust": action}, {"policy": observed}
            self.rewards, self.terminations = {}, {"time_out": DoneTerm(func=mdp.time_out, time_out=True)}

    env = make_env(resolve(source_of(Cfg(), tmp_path)), seed=0)
    env.reset()
    term = env.action_manager.terms[0].instance
    drone = facade_of(env).scene["robot"]
    term.process(torch.tensor([[1.0, 0.0, -0.5, 0.5]] * 2))
    assert drone.data.thrust_target.tolist() == [[300.0] * 4] * 2  # as in Isaac Lab: the speed, before the first step
    term.apply()
    assert drone.data.thrust_target.tolist() == [[4.0, 3.0, 1.5, 4.5]] * 2
    wrench = drone.data.applied_thrust.double().numpy() @ np.array(ALLOCATION).T
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array([0.9, 0.1, 0.2, 0.3]) / np.linalg.norm([0.9, 0.1, 0.2, 0.3]))
    turn = turn.reshape(3, 3)
    applied = env.engine.field("xfrc_applied")[:, env.entities["robot"].body_ids[0]].numpy()
    np.testing.assert_allclose(applied[:, :3], wrench[:, :3] @ turn.T, atol=1e-5)
    np.testing.assert_allclose(applied[:, 3:], wrench[:, 3:] @ turn.T, atol=1e-5)


# --- curricula, commands, collections ---


def test_curriculum_changes_weight_range_and_noise_by_address(tmp_path):
    def grow(env, env_ids, data, to, after):
        return to if env.common_step_counter > after else mdp.modify_term_cfg.NO_CHANGE

    def term(address, to):
        params = {"address": address, "modify_fn": grow, "modify_params": {"to": to, "after": 2}}
        return CurrTerm(func=mdp.modify_term_cfg, params=params)

    gravity = EventTerm(
        func=mdp.randomize_physics_scene_gravity, mode="reset",
        params={"gravity_distribution_params": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), "operation": "abs"},
    )  # fmt: skip
    changes = {
        "events": {"gravity": gravity},
        "curriculum": {
            "weight": term("rewards.speed.weight", -3.0),
            "noise": term("observations.policy.position.noise.n_max", 0.4),
            "gravity": term("events.gravity.params.gravity_distribution_params", ((0, 0, -5.0), (0, 0, -4.0))),
        },
    }
    env = task(tmp_path, osc(), **changes)
    seen = {name: value.clone() for name, value in env._binder.tunable.tensors().items()}
    assert seen["rewards.speed.weight"] == -1.0
    for _ in range(3):
        env.step(torch.zeros(ENVS, 7))
    env.curriculum_manager.compute(env._select_all())
    found = env._binder.tunable.tensors()
    assert found["rewards.speed.weight"] == -3.0
    assert found["observations.policy.position.noise.high"].item() == pytest.approx(0.4)
    assert found["events.gravity.range"].tolist() == [[0.0, 0.0], [0.0, 0.0], [-5.0, -4.0]]


def test_curriculum_of_an_address_that_names_no_number(tmp_path):
    wrong = CurrTerm(func=mdp.modify_term_cfg, params={"address": "rewards.speed.func", "modify_fn": max})
    with pytest.raises(ConfigError, match=r"'rewards\.speed\.func' names no setting that rlcli can change"):
        task(tmp_path, osc(), curriculum={"wrong": wrong})


class MirroredPose(UniformPoseCommand):
    """Isaac Lab's command, changed in one method."""

    def _resample_command(self, env_ids):
        super()._resample_command(env_ids)
        self.pose_command_b[env_ids, 1] = -self.pose_command_b[env_ids, 0]


def test_subclass_of_a_command_of_isaac_lab(tmp_path):
    @configclass
    class Ranges:
        pos_x = pos_y = pos_z = (0.2, 0.4)
        roll = pitch = yaw = (-1.0, 1.0)

    @configclass
    class MirroredCfg(CommandTermCfg):
        class_type: type = MirroredPose
        asset_name: str = "robot"
        body_name: str = "tool"
        make_quat_unique: bool = True
        ranges: Ranges = Ranges()

    env = task(tmp_path, osc(), commands={"pose": MirroredCfg(resampling_time_range=(9.0, 9.0))})
    command = facade_of(env).command_manager.get_command("pose")
    assert torch.equal(command[:, 1], -command[:, 0])
    assert bool(((command[:, :1] >= 0.2) & (command[:, :1] <= 0.4)).all())
    assert torch.allclose(command[:, 3:].norm(dim=1), torch.ones(ENVS))
    term = facade_of(env).command_manager.get_term("pose")
    term._update_metrics()
    data = facade_of(env).scene["robot"].data
    distance = (term.pose_command_w[:, :3] - data.body_pos_w[:, term.body_idx]).norm(dim=1)
    torch.testing.assert_close(term.metrics["position_error"], distance)


def test_objects_of_a_collection(tmp_path):
    def block(name):
        return RigidObjectCfg(
            prim_path=f"E/{name}", spawn=sim_utils.CuboidCfg(size=(0.1, 0.1, 0.1), rigid_props={"disable_gravity": None}),
            init_state=RigidObjectCfg.InitialStateCfg(pos=(1.0, 0.0, 0.5)),
        )  # fmt: skip

    @configclass
    class SceneCfg(InteractiveSceneCfg):
        robot = ArticulationCfg(
            prim_path="R/Robot", spawn=sim_utils.UsdFileCfg(usd_path="arm.xml"),
            actuators={"all": ImplicitActuatorCfg(joint_names_expr=["j.*"], stiffness=0.0, damping=0.5)},
        )  # fmt: skip
        blocks = lab_name("RigidObjectCollectionCfg")(rigid_objects={"red": block("Red"), "blue": block("Blue")})

    env = task(tmp_path, osc(), scene=SceneCfg(num_envs=ENVS, env_spacing=4.0))
    blocks = facade_of(env).scene["blocks"]
    assert blocks.object_names == ["red", "blue"]
    state = torch.zeros(2, 2, 13)
    state[..., 3] = 1.0
    state[:, 0, :3], state[:, 1, :3] = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([4.0, 5.0, 6.0])
    blocks.write_object_state_to_sim(state, env_ids=torch.tensor([0, 3]))
    assert blocks.data.object_pos_w[[0, 3]].tolist() == [[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]] * 2
    assert blocks.data.object_pos_w[1, 0].tolist() == pytest.approx([1.0, 0.0, 0.5], abs=1e-3)


def test_own_event_names_its_selection(tmp_path):
    picked = Pick("robot", joint_names=["j6", "j0"], preserve_order=True)
    seen = []

    def look(env, env_ids, asset_cfg):
        seen.append(asset_cfg.joint_names)

    task(tmp_path, osc(), events={"look": EventTerm(func=look, mode="startup", params={"asset_cfg": picked})})
    assert seen == [["j6", "j0"]]
