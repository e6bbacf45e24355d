"""The linter finds each planted defect with its rule and place, and nothing in correct tasks."""

import contextlib
import json
from pathlib import Path

import pytest

from rlcli import progress
from rlcli.cli.app import main
from rlcli.testing import RULES, lint_task

ACROBOT = Path(__file__).parents[2] / "plugins" / "rlcli-example-acrobot" / "rlcli_example_acrobot"


def lint(folder, **arguments):
    found = lint_task(folder.write(), **arguments)
    assert all(f.where and f.message and f.hint and f.numbers for f in found)
    return found


def rules(folder, **arguments):
    """Return rule -> its first remark."""
    found = {}
    for remark in lint(folder, **arguments):
        found.setdefault(remark.rule, remark)
    return found


# --- correct tasks ---


def test_example_plugin_has_no_remarks():
    assert lint_task(ACROBOT) == []


def test_correct_tasks_have_no_remarks(managed, direct):
    assert lint(managed) == []
    direct.path = direct.path.with_name("direct")
    assert lint(direct) == []


# --- resets ---


def test_early_resets_finds_start_beyond_termination(managed):
    managed.config["terminations"]["fell"] = {"func": "joint_pos_out_of_manual_limit", "bounds": [-0.1, 0.1]}
    managed.config["rewards"]["alive"] = {"func": "is_alive", "weight": 2.0}
    found = rules(managed)
    assert found["early-resets"].severity == "error"
    assert found["early-resets"].where == "terminations: fell"
    assert found["early-resets"].numbers["share"] > 0.5


def test_early_resets_finds_direct_task_done_at_start(direct):
    direct.replace("self.obs_buf[:, 0].abs() > 3.0", "self.obs_buf[:, 0].abs() > 0.3")
    assert rules(direct)["early-resets"].where == "terminations: task"


FLOATING = """<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="{size}" mass="1"/>
      <body name="link" pos="0 0 0.1">
        <joint name="hinge" axis="0 1 0" damping="0.1" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02" mass="0.2" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("size", "func", "falls"),
    [
        ("0.02 0.02 0.2", "joint_position", True),
        ("0.3 0.3 0.2", "joint_position", False),
        ("0.02 0.02 0.2", "joint_effort", False),
    ],
)
def test_start_pose_falls_finds_a_robot_that_its_default_pose_does_not_hold(managed, size, func, falls):
    managed.xml = FLOATING.format(size=size)
    config = managed.config
    config["scene"]["entities"]["robot"] = {"model": "pendulum.xml", "pos": [0.0, 0.0, 0.2]}
    config["scene"]["entities"]["robot"]["joints"] = {"hinge": {"kp": 20.0, "kv": 1.0, "effort_limit": 5.0}}
    config["actions"] = {"legs": {"func": func, "joints": ["hinge"]}}
    config["events"] = {"start": {"func": "reset_root_state_uniform", "mode": "reset", "roll": [0.2, 0.3]}}
    config["terminations"]["tilted"] = {"func": "bad_orientation", "limit_angle": 0.6}
    found = [remark for remark in lint(managed, only=["start-pose-falls"]) if remark.rule == "start-pose-falls"]
    assert bool(found) is falls
    if falls:
        assert "by tilted" in found[0].message
        assert found[0].severity == "warning"


def test_degrees_finds_angles_that_are_too_large_for_radians(managed):
    managed.config["terminations"]["tilted"] = {"func": "bad_orientation", "limit_angle": 35}
    managed.config["events"]["root"] = {"func": "reset_root_state_uniform", "mode": "reset", "pitch": [-8.0, 8.0]}
    managed.config["events"]["legal"] = {"func": "reset_root_state_uniform", "mode": "reset", "yaw": [-6.2832, 6.2832]}
    managed.config["success"] = {"upright": {"func": "root_tilt", "at_most": 20.0}}
    found = [remark for remark in lint(managed, only=["degrees"]) if remark.rule == "degrees"]
    places = ["events.root.pitch", "success.upright.at_most", "terminations.tilted.limit_angle"]
    assert sorted(remark.where for remark in found) == places
    assert "write 0.6109" in next(remark.hint for remark in found if "limit_angle" in remark.where)


def test_degrees_finds_joint_positions(managed):
    managed.config["events"]["start"]["position"] = [-10.0, 10.0]
    managed.config["scene"]["entities"]["robot"]["init"] = {"joint_pos": {"hinge": 45.0}}
    found = [remark.where for remark in lint(managed, only=["degrees"])]
    assert sorted(found) == ["events.start.position", "scene.entities.robot.init.joint_pos.hinge"]


def test_joint_limits_finds_radians_in_a_file_with_degrees_and_the_reverse(managed):
    plain = managed.xml
    for limits, message in (("-1.5 1.5", "no hinge with limits turns further"), ("-1800 1800", "more than two turns")):
        managed.xml = plain.replace('name="hinge"', f'name="hinge" limited="true" range="{limits}"')
        (remark,) = [remark for remark in lint(managed, only=["joint-limits"]) if remark.rule == "joint-limits"]
        assert remark.where == "scene.entities.robot.model"
        assert message in remark.message


# --- rewards ---


def test_silent_reward_finds_term_that_is_always_zero(managed):
    managed.terms = (
        "def far(env, *, entity: Entity = 'robot') -> Tensor:\n"
        "    return (entity.data.joint_pos[:, 0].abs() > 100.0).float()\n"
    )
    managed.config["rewards"]["far"] = {"func": "far", "weight": 1.0}
    (remark,) = lint(managed)
    assert (remark.rule, remark.where) == ("silent-reward", "rewards.far")


def test_silent_reward_ignores_weight_0(managed):
    managed.config["rewards"]["rate"] = {"func": "joint_vel_l2", "weight": 0.0}
    assert lint(managed) == []


def test_dominant_reward_finds_oversized_term(managed):
    managed.config["rewards"]["rate"] = {"func": "joint_vel_l2", "weight": -50.0}
    (remark,) = lint(managed)
    assert (remark.rule, remark.where) == ("dominant-reward", "rewards.rate")
    assert "upright" in remark.message
    assert remark.numbers["share"] > 0.99


def test_constant_reward_finds_constant(direct):
    direct.replace("1.0 - self.obs_buf[:, 0].square()", "1.0")
    direct.replace("self.obs_buf[:, 0].abs() > 3.0", "self.obs_buf[:, 0].abs() > 1e9")
    (remark,) = lint(direct)
    assert (remark.rule, remark.where) == ("constant-reward", "rew_buf")


def test_constant_reward_finds_zero_with_termination(direct):
    direct.replace("1.0 - self.obs_buf[:, 0].square()", "0.0")
    (remark,) = [each for each in lint(direct) if each.rule == "constant-reward"]
    assert "is 0 in every step" in remark.message


def test_constant_reward_accepts_alive_bonus_with_termination(direct):
    direct.replace("1.0 - self.obs_buf[:, 0].square()", "1.0")
    assert lint(direct) == []


def test_dying_pays_finds_negative_rewards_with_termination(managed):
    managed.config["rewards"] = {
        "rate": {"func": "joint_vel_l2", "weight": -0.2},
        "effort": {"func": "action_l2", "weight": -1.0},
        "life": {"func": "is_alive", "weight": -1.0},
    }
    managed.config["terminations"]["fell"] = {"func": "joint_pos_out_of_manual_limit", "bounds": [-2.0, 2.0]}
    (remark,) = lint(managed)
    assert (remark.rule, remark.severity) == ("dying-pays", "error")
    assert remark.numbers["good_step"] < 0.0
    assert "is_alive" in remark.hint


def test_dying_pays_warns_about_bonus_for_termination(managed):
    managed.config["rewards"] = {
        "alive": {"func": "is_alive", "weight": 0.1},
        "fell": {"func": "is_terminated", "weight": 100.0},
    }
    managed.config["terminations"]["fell"] = {"func": "joint_pos_out_of_manual_limit", "bounds": [-2.0, 2.0]}
    remark = rules(managed)["dying-pays"]
    assert remark.severity == "warning"
    assert remark.numbers["last_step"] == pytest.approx(2.0)


def test_dying_pays_accepts_termination_penalty(managed):
    managed.config["rewards"]["fell"] = {"func": "is_terminated", "weight": -400.0}
    managed.config["terminations"]["fell"] = {"func": "joint_pos_out_of_manual_limit", "bounds": [-2.0, 2.0]}
    assert "dying-pays" not in rules(managed)


# --- observations and actions ---


def test_observation_scale_finds_column_and_proposes_scale(managed):
    managed.config["observations"]["policy"]["rate"]["scale"] = 1000.0
    (remark,) = lint(managed)
    assert remark.rule == "observation-scale"
    assert "column 1 (rate" in remark.where
    assert "scale: 0.0001" in remark.hint
    managed.config["observations"]["policy"]["rate"]["scale"] = 1e-5
    (remark,) = lint(managed)
    assert remark.numbers["largest"] < 0.001


def test_observation_scale_names_angle_that_grows_with_each_turn(managed):
    managed.config["episode_length_s"] = 8.0
    managed.config["actions"]["torque"]["scale"] = 8.0
    managed.config["scene"]["entities"]["robot"]["joints"]["hinge"]["effort_limit"] = 8.0
    found = [remark for remark in lint(managed, only=["observation-scale"]) if "column 0" in remark.where]
    assert ["joint_angle" in remark.hint for remark in found] == [True]
    managed.config["observations"]["policy"]["angle"]["func"] = "joint_angle"
    assert not [remark for remark in lint(managed, only=["observation-scale"]) if "column 0" in remark.where]


def test_observation_scale_accepts_normalizing_agent(managed):
    managed.config["observations"]["policy"]["rate"]["scale"] = 1000.0
    managed.config["agents"] = agents(normalize_observations=True)
    assert lint(managed) == []


def test_constant_observation_finds_column(direct):
    direct.replace("self.obs_buf[:, 1] = self.arms.get_joint_velocities()[:, 0]", "self.obs_buf[:, 1] = 0.5")
    (remark,) = lint(direct)
    assert (remark.rule, remark.severity) == ("constant-observation", "error")
    assert "column 1" in remark.where


def test_saturated_actions_finds_saturated_actuator(managed):
    managed.config["actions"]["torque"]["scale"] = 300.0
    (remark,) = lint(managed)
    assert remark.rule == "saturated-actions"
    assert "joint 'hinge'" in remark.where
    assert remark.numbers["share"] > 0.9


def test_saturated_actions_finds_clipped_action(direct):
    direct.config["clip_actions"] = 0.05
    (remark,) = lint(direct)
    assert remark.rule == "saturated-actions"
    assert "column 0 of the action" in remark.where


@pytest.mark.parametrize("planted", ["without force", "column that nothing reads"])
def test_dead_action_finds_action_without_effect(planted, managed, direct):
    if planted == "without force":
        managed.config["actions"]["torque"]["scale"] = 0.0
        (remark,) = lint(managed)
    else:
        direct.replace("num_actions = 1", "num_actions = 2")
        direct.replace("self.params.max_effort * actions", "self.params.max_effort * actions[:, :1]")
        (remark,) = lint(direct)
        assert "column 1" in remark.where
    assert (remark.rule, remark.severity) == ("dead-action", "error")
    assert remark.numbers["moved"] == 0.0


def test_dead_action_accepts_action_that_scales_another(direct):
    direct.replace("num_actions = 1", "num_actions = 2")
    direct.replace(
        "self.params.max_effort * actions", "self.params.max_effort * actions[:, :1] * (1.0 + 0.5 * actions[:, 1:])"
    )
    assert lint(direct) == []


# --- time ---


def stiff(managed, stiffness, dt):
    managed.xml = managed.xml.replace('damping="0.05"', f'damping="0" armature="0.0001" stiffness="{stiffness}"')
    managed.config["sim"] = {"dt": dt}
    managed.config["decimation"] = 1


def test_timestep_finds_energy_drift(managed):
    stiff(managed, 200.0, 0.02)
    remark = rules(managed)["timestep"]
    assert remark.where == "sim.dt = 0.02 s"
    assert remark.numbers["energy_drift"] > 0.2
    stiff(managed, 200.0, 0.0005)
    assert "timestep" not in rules(managed, seconds=0.1)


def test_timestep_finds_divergence(managed):
    managed.xml = managed.xml.replace('damping="0.05"', 'armature="0.0001" stiffness="200000"')
    managed.config["sim"] = {"dt": 0.05, "integrator": "rk4"}
    remark = rules(managed)["timestep"]
    assert remark.severity == "error"
    assert remark.numbers["diverged"] > 0


def test_timestep_finds_gain_too_high(managed):
    managed.config["actions"] = {"target": {"func": "joint_position", "joints": ["hinge"]}}
    managed.config["scene"]["entities"]["robot"]["joints"] = {"hinge": {"kp": 500.0, "kv": 0.0}}
    managed.config["sim"] = {"dt": 0.05}
    assert "timestep" in rules(managed)


@pytest.mark.parametrize(("gamma", "found"), [(0.5, True), (0.99, False), (0.99999, True)])
def test_horizon_finds_unsuitable_discount(gamma, found, managed):
    managed.config["agents"] = agents(gamma=gamma)
    remarks = lint(managed, only=["horizon"])
    assert [r.where for r in remarks] == ([f"agents.sb3.gamma = {gamma:g}"] if found else [])
    assert all(r.numbers["episode"] == 100 for r in remarks)


def agents(**settings):
    return {"default": "sb3", "sb3": {"trainer": "sb3", "algorithm": "ppo", "max_iterations": 1, **settings}}


def test_horizon_checks_all_agents_or_selected_one(managed):
    managed.config["agents"] = agents() | {"other": {**agents()["sb3"], "gamma": 0.1}}
    assert [r.where for r in lint(managed, only=["horizon"])] == ["agents.other.gamma = 0.1"]
    assert lint(managed, only=["horizon"], agent="sb3") == []


# --- the rules themselves ---


def test_task_that_raises_in_step_is_one_remark(direct):
    direct.replace(
        "    def is_done(self):\n",
        "    def is_done(self):\n        if self.env.common_step > 5:\n            raise KeyError('late')\n",
    )
    (remark,) = lint(direct)
    assert remark.rule == "stops"
    assert "KeyError: 'late'" in remark.message
    assert "task.py:" in remark.where


def test_task_that_raises_before_first_step_is_one_remark(direct):
    direct.replace("    def is_done(self):\n", "    def is_done(self):\n        raise KeyError('done')\n")
    (remark,) = lint(direct)
    assert remark.numbers == {"step": 0}


def test_lint_task_is_deterministic(managed):
    managed.config["observations"]["policy"]["rate"]["scale"] = 1000.0
    assert lint(managed) == lint(managed)


def test_rules_have_docstrings():
    assert all((rule.__doc__ or "").split("\n")[0].endswith(".") for rule in RULES.values())


# --- the command ---


def command(capsys, *arguments):
    """Run `rlcli lint`; return (exit code, stdout, stderr)."""
    code = main(["lint", *map(str, arguments)])
    return code, *capsys.readouterr()


def test_command_prints_table_and_exits_0(managed, capsys):
    code, out, err = command(capsys, managed.write(), "--seconds", "0.5")
    assert code == 0
    assert out.splitlines()[0].split() == ["RULE", "RESULT"]
    assert [line.split()[0] for line in out.splitlines()[1:-1]] == list(RULES)
    assert out.splitlines()[-1].endswith("0 errors, 0 warnings")
    assert err == ""


def test_command_exits_9_on_warning_unless_ignored(managed, capsys):
    managed.config["agents"] = agents(gamma=0.5)
    code, out, _ = command(capsys, managed.write(), "--seconds", "0.2")
    assert code == 9
    assert "warning: horizon: agents.sb3.gamma = 0.5" in out
    assert command(capsys, managed.path, "--seconds", "0.2", "--ignore", "horizon")[0] == 0


def test_command_json_document(managed, capsys):
    managed.config["actions"]["torque"]["scale"] = 0.0
    code, out, _ = command(capsys, managed.write(), "--json", "--seconds", "0.2")
    document = json.loads(out)
    assert code == 9
    assert document["passed"] is False
    assert {r["name"]: r["result"] for r in document["rules"]}["dead-action"] == "error"
    (finding,) = document["findings"]
    assert set(finding) == {"rule", "severity", "where", "message", "hint", "numbers"}
    assert finding["numbers"]["moved"] == 0.0


def test_command_rejects_unknown_rule_task_and_time(managed, capsys):
    folder = managed.write()
    code, _, err = command(capsys, folder, "--only", "horizons")
    assert code == 2
    assert "did you mean 'horizon'" in err
    assert command(capsys, folder, "--seconds", "-1")[0] == 2
    assert command(capsys, "cartpoel")[0] == 4
    assert command(capsys, folder, "decimation=0")[0] == 3


def test_progress_counts_rollouts_before_rules(managed, monkeypatch):
    ended = []

    @contextlib.contextmanager
    def view(running):
        yield
        ended.append(running[0].what)  # the outermost operation, which is not shown as a part of another one

    monkeypatch.setattr(progress, "view", view)
    lint(managed)
    assert [name for name in ended if name in ("policies", "rules")] == ["policies", "rules"]
