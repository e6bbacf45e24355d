"""Actuator settings: every key takes effect on the joints of its group, or is reported."""

import pytest
import torch
from support.worlds import CRITTER
from test_isaaclab_user_code import rover

from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli_isaaclab import (
    ArticulationCfg,
    DCMotorCfg,
    DoneTerm,
    IdealPDActuatorCfg,
    ImplicitActuatorCfg,
    InteractiveSceneCfg,
    ManagerBasedRLEnvCfg,
    ObsGroup,
    ObsTerm,
    RewTerm,
    configclass,
    mdp,
    sim_utils,
)

torch.set_num_threads(1)


@configclass
class Policy(ObsGroup):
    speed = ObsTerm(func=mdp.joint_vel)


def task(folder, action=mdp.JointPositionActionCfg, **actuators):
    (folder / "critter.xml").write_text(CRITTER)

    @configclass
    class SceneCfg(InteractiveSceneCfg):
        robot = ArticulationCfg(prim_path="R/Robot", spawn=sim_utils.UsdFileCfg(usd_path="critter.xml"),
                                init_state=ArticulationCfg.InitialStateCfg(pos=(0, 0, 0.35)),
                                soft_joint_pos_limit_factor=0.5, actuators=actuators)  # fmt: skip

    @configclass
    class Cfg(ManagerBasedRLEnvCfg):
        scene: SceneCfg = SceneCfg(num_envs=2, env_spacing=4.0)

        def __post_init__(self):
            self.decimation, self.episode_length_s = 2, 1.0
            self.actions = {"legs": action(asset_name="robot", joint_names=[".*"])}
            self.observations = {"policy": Policy()}
            self.rewards = {"fast": RewTerm(func=mdp.joint_vel_limits, weight=1.0, params={"soft_ratio": 0.5}),
                            "effort": RewTerm(func=mdp.joint_torques_l2, weight=1.0)}  # fmt: skip
            self.terminations = {"time_out": DoneTerm(func=mdp.time_out, time_out=True)}

    return resolve(source_of(Cfg(), folder))


def robot(resolved):
    env = make_env(resolved)
    env.reset()
    return env, env.entities["robot"]


def notes(resolved):
    return {note.key.removeprefix("scene.robot.actuators."): note.status for note in resolved.notes}


def implicit(names, **settings):
    return ImplicitActuatorCfg(joint_names_expr=names, **{"stiffness": 20.0, "damping": 0.5, **settings})


LIMITS = {
    "DC motor": (DCMotorCfg, {"velocity_limit": 30.0, "saturation_effort": 9.0}, 30.0),
    "ideal PD": (IdealPDActuatorCfg, {"velocity_limit": 20.0}, 20.0),
    "solver's": (IdealPDActuatorCfg, {"velocity_limit_sim": 12.0}, 12.0),
    "actuator's before solver's": (IdealPDActuatorCfg, {"velocity_limit": 20.0, "velocity_limit_sim": 12.0}, 20.0),
    "implicit": (ImplicitActuatorCfg, {"velocity_limit_sim": 7.0}, 7.0),
    "implicit, without effect": (ImplicitActuatorCfg, {"velocity_limit": 7.0}, float("inf")),
    "none": (ImplicitActuatorCfg, {}, float("inf")),
}


@pytest.mark.parametrize("case", LIMITS)
def test_terms_read_the_speed_limit(tmp_path, case):
    kind, settings, limit = LIMITS[case]
    made = kind(joint_names_expr=[".*"], stiffness=20.0, damping=0.5, effort_limit=8.0, **settings)
    env, entity = robot(task(tmp_path, legs=made))
    assert entity.data.joint_vel_limits.tolist() == [limit] * 4
    fast = next(term for term in env.reward_manager.terms if term.name == "fast").instance
    env.engine.field("qvel")[:, 6:] = torch.tensor([0.0, 0.5 * limit + 0.25, -0.5 * limit - 0.5, 5.0]).nan_to_num(0.0)
    env.sim.refresh()
    value = next(v for v in [fast()] if v is not None)
    expected = 0.0 if limit == float("inf") else 0.75 + min(max(5.0 - 0.5 * limit, 0.0), 1.0)
    assert value.tolist() == pytest.approx([expected] * 2, abs=1e-5)


def test_speed_limits_of_a_motor_by_joint(tmp_path):
    motor = DCMotorCfg(
        joint_names_expr=["hip_.*"], stiffness=20.0, damping=0.5, effort_limit=8.0, saturation_effort=9.0,
        velocity_limit={"hip_f.": 30.0, "hip_b.": 20.0},
    )  # fmt: skip
    env, entity = robot(task(tmp_path, legs=motor))
    assert entity.data.joint_vel_limits.tolist() == [30.0, 30.0, 20.0, 20.0]
    model = entity.actuators[0]
    env.engine.field("qvel")[:, 6:] = 15.0
    model.targets[:, 2] = 100.0
    model.compute()
    torch.testing.assert_close(model.applied_effort[0], torch.tensor([4.5, 4.5, 2.25, 2.25]))


def test_regexes_count_only_within_their_group(tmp_path):
    front = implicit(["hip_f."], stiffness={".*": 20.0}, damping={".*l": 0.5, ".*r": 0.75}, effort_limit_sim=8.0)
    back = implicit(["hip_b."], stiffness=5.0, damping=0.25, friction={"hip_bl": 0.1}, armature=0.02)
    env, _ = robot(task(tmp_path, front=front, back=back))
    model = env.engine.model
    gains = {model.actuator(a).name: (model.actuator_gainprm[a, 0], -model.actuator_biasprm[a, 2]) for a in range(4)}
    assert gains == {"robot/hip_fl": (20.0, 0.5), "robot/hip_fr": (20.0, 0.75), "robot/hip_bl": (5.0, 0.25),
                     "robot/hip_br": (5.0, 0.25)}  # fmt: skip
    assert model.dof_frictionloss[6:].tolist() == [0.0, 0.0, 0.1, 0.0]
    assert model.dof_armature[6:].tolist() == [0.01, 0.01, 0.02, 0.02]
    limited = {model.actuator(a).name for a in range(4) if model.actuator_forcelimited[a]}
    assert limited == {"robot/hip_fl", "robot/hip_fr"}


def test_equal_regexes_in_two_groups_are_kept_apart(tmp_path):
    left = implicit([".*l"], stiffness={".*": 20.0}, armature={".*": 0.05})
    right = implicit([".*r"], stiffness={".*": 5.0})
    model = robot(task(tmp_path, left=left, right=right))[0].engine.model
    gains = {model.actuator(a).name[-1]: model.actuator_gainprm[a, 0] for a in range(4)}
    assert gains == {"l": 20.0, "r": 5.0}
    assert model.dof_armature[6:].tolist() == [0.05, 0.01, 0.05, 0.01]


def test_viscous_friction_is_damping_of_the_joint(tmp_path):
    damped = implicit([".*"], viscous_friction={"hip_f.": 0.3, "hip_b.": 0.0})
    model = robot(task(tmp_path, legs=damped))[0].engine.model
    assert model.dof_damping[6:].flatten().tolist()[:2] == [0.3, 0.3]
    free = implicit([".*"], stiffness=0.0, viscous_friction=0.3)
    resolved = task(tmp_path, mdp.JointEffortActionCfg, legs=free)
    assert notes(resolved)["rewards.effort.func"] == "approximated"  # the drive's damping is no effort
    model = robot(resolved)[0].engine.model
    assert model.dof_damping[6:].flatten().tolist()[0] == 0.8


def test_damping_of_the_mjcf_beside_an_actuator_is_reported(tmp_path):
    resolved = task(tmp_path, legs=implicit([".*"]))
    model = robot(resolved)[0].engine.model
    (note,) = [note for note in resolved.notes if "scene.robot.actuators.damping" in note.key]
    start = f"the damping of the MJCF's joints, at most {model.dof_damping.max():g}, acts in addition: "
    assert note.text.startswith(start)
    assert set(note.text.removeprefix(start).split(", ")) <= {model.joint(i).name.split("/")[-1] for i in range(1, 5)}
    without = task(tmp_path, mdp.JointEffortActionCfg, legs=implicit([".*"], stiffness=0.0))
    assert "damping" not in notes(without)


def test_keys_without_counterpart_are_reported(tmp_path):
    front = implicit(["hip_f."], velocity_limit_sim=9.0, dynamic_friction=0.1, friction=0.2)
    back = IdealPDActuatorCfg(joint_names_expr=["hip_b."], stiffness=5.0, damping=None, effort_limit_sim=4.0)
    found = notes(task(tmp_path, front=front, back=back))
    assert found["front.velocity_limit_sim"] == "approximated"
    assert found["front.dynamic_friction"] == "ignored"
    assert found["back.effort_limit_sim"] == "ignored"
    assert found["back.effort_limit"] == found["back.damping"] == "approximated"
    unused = notes(task(tmp_path, legs=implicit([".*"], velocity_limit=9.0)))
    assert unused["legs.velocity_limit"] == "ignored"


def test_two_different_limits_of_an_implicit_actuator_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="effort_limit and effort_limit_sim of an implicit actuator differ"):
        task(tmp_path, legs=implicit([".*"], effort_limit=9.0, effort_limit_sim=8.0))


def test_soft_limits_are_narrowed_about_the_middle(tmp_path):
    _, entity = robot(task(tmp_path, legs=implicit([".*"])))
    half = torch.tensor([-0.5, 0.5]) * torch.pi / 3
    torch.testing.assert_close(entity.data.soft_joint_pos_limits, half.expand(4, 2))


def test_commands_of_a_passive_joint_have_no_effect(tmp_path):
    action = 'wheel = mdp.JointVelocityActionCfg(asset_name="robot", joint_names=["wheel"])'
    resolved = rover(tmp_path / "rover", "", [(action, action.replace("Velocity", "Position"))])
    robot = resolved.task.scene.entities["robot"]
    assert robot.actuators["passive_joints"].joints == ["wheel"]
    assert robot.joints["wheel"].damping == 2.0
    env = make_env(resolved, seed=0)
    env.reset()
    for _ in range(5):
        env.step(torch.tensor([0.0, 1.0]).expand(4, 2).clone())
    assert float(env.entities["robot"].data.joint_vel[:, 1].abs().max()) == pytest.approx(0.0, abs=1e-6)
