"""Each check finds the planted defect that breaks its clause of the contract, and its place."""

import contextlib
from pathlib import Path

import pytest

from rlcli import progress
from rlcli.testing import CHECKS, check_task

ACROBOT = Path(__file__).parents[2] / "plugins" / "rlcli-example-acrobot" / "rlcli_example_acrobot"


OTHER_ENGINE = ("engines", "captured")
"""Checks with separate tests: their environments are slow to build."""


def check(folder):
    found = check_task(folder.write(), only=[name for name in CHECKS if name not in OTHER_ENGINE])
    assert all(f.where and f.message and f.hint for f in found)
    return found


def errors(folder):
    """Return check -> its first error."""
    found = {}
    for finding in check(folder):
        if finding.severity == "error":
            found.setdefault(finding.check, finding)
    return found


def test_example_plugin_has_no_findings():
    assert check_task(ACROBOT) == []


def test_correct_tasks_have_no_findings(managed, direct):
    assert check(managed) == []
    direct.path = direct.path.with_name("direct")
    assert check(direct) == []


def test_checks_have_docstrings():
    assert all((function.__doc__ or "").split("\n")[0].endswith(".") for function in CHECKS.values())


# --- names ---


JOINT = '<joint type="hinge" axis="1 0 0" damping="0.05"/><geom name="arm"'
BODY = '<body pos="0 0 0.5"><geom size="0.02" mass="0.1" contype="0" conaffinity="0"/></body></body>'
ACTUATOR = '<actuator><position joint="hinge" kp="0.1"/></actuator></mujoco>'


@pytest.mark.parametrize(
    ("word", "place", "old", "new"),
    [
        ("joint", "in 'arm'", '<geom name="arm"', JOINT),
        ("body", "in 'arm'", "</body>", BODY),
        ("actuator", "on 'hinge'", "</mujoco>", ACTUATOR),
    ],
)
def test_names_finds_unnamed_elements(word, place, old, new, managed):
    managed.xml = managed.xml.replace(old, new)
    (finding,) = [f for f in check_task(managed.write(), only=["names"]) if f.check == "names"]
    assert f"{word} without a name: {place}" in finding.message
    assert "pendulum.xml" in finding.where
    assert f"<{word} name=" in finding.hint


def test_names_accepts_unnamed_free_joint(managed):
    managed.xml = managed.xml.replace("</worldbody>", FREE + "</worldbody>")
    assert check_task(managed.write(), only=["names"]) == []


FREE = '<body name="ball"><freejoint/><geom size="0.02" mass="0.1" contype="0" conaffinity="0"/></body>'


def test_names_finds_all_missing_joints(managed):
    managed.config["rewards"]["upright"]["joints"] = ["hinges"]
    managed.config["events"]["start"]["joints"] = ["elbow"]
    found = check(managed)
    assert [f.check for f in found] == ["names", "names"]
    text = " ".join(map(str, found))
    assert "rewards.upright.joints" in text
    assert "did you mean 'hinge'" in text
    assert "elbow" in text


# --- files ---


def test_yaml_round_trip_finds_infinite_value(managed):
    managed.terms = (
        "def near(env, *, entity: Entity = 'robot', limit: float = 1e999) -> Tensor:\n"
        "    return (entity.data.joint_pos[:, 0].abs() < limit)\n"
    )
    managed.config["rewards"]["near"] = {"func": "near", "weight": 1.0}
    assert "rewards.near.limit" in errors(managed)["yaml-round-trip"].where


# --- results of a step ---


def test_finite_finds_late_nan_and_names_term(managed):
    managed.terms = "def root(env) -> Tensor:\n    return torch.sqrt(60.0 - env.episode_length_buf.float())\n"
    managed.config["rewards"]["root"] = {"func": "root", "weight": 1.0}
    finding = errors(managed)["finite"]
    assert "'root'" in finding.message


def test_shapes_finds_wrong_term_shape(managed):
    managed.terms = "def flat(env, *, entity: Entity = 'robot') -> Tensor:\n    return entity.data.joint_pos[:, :1]\n"
    managed.config["rewards"]["flat"] = {"func": "flat", "weight": 1.0}
    finding = errors(managed)["shapes"]
    assert "rewards.flat" in finding.where
    assert "(8, 1)" in finding.message


def test_shapes_finds_wrong_buffer_shape(direct):
    direct.replace(
        "self.rew_buf[:] = 1.0 - self.obs_buf[:, 0].square()", "self.rew_buf = 1.0 - self.obs_buf[:, 0].square().mean()"
    )
    assert errors(direct)["shapes"].where == "rew_buf"


def test_dtypes_finds_float64_observations(direct):
    direct.replace(
        "    def set_up_scene",
        "    def post_reset(self):\n        self.obs_buf = self.obs_buf.double()\n\n    def set_up_scene",
    )
    finding = errors(direct)["dtypes"]
    assert finding.where == "obs_buf"
    assert "float64" in finding.message
    assert "float32" in finding.message


def test_dtypes_finds_termination_that_is_not_bool(managed):
    managed.terms = (
        "def fell(env, *, entity: Entity = 'robot') -> Tensor:\n"
        "    return (entity.data.joint_pos[:, 0].abs() > 1.0).to(torch.uint8)\n"
    )
    managed.config["terminations"]["fell"] = {"func": "fell"}
    assert "terminations.fell" in str(errors(managed)["dtypes"])


def test_random_and_extreme_actions_find_unstable_time_step(managed):
    managed.xml = managed.xml.replace('damping="0.05"', 'armature="0.0001" stiffness="200000"')
    managed.config["sim"] = {"dt": 0.05, "integrator": "rk4"}
    found = errors(managed)
    assert "sim.dt = 0.05" in found["random-actions"].where
    assert "smaller sim.dt" in found["random-actions"].hint
    assert "extreme-actions" in found


def test_extreme_actions_finds_divergence_only_near_bound(direct):
    # a gain that explodes only near the bound, which uniform draws do not reach
    direct.replace(
        "self.arms.set_joint_efforts(self.params.max_effort * actions)",
        "self.arms.set_joint_efforts(torch.where(actions.abs() > 0.9999, 1e9 * actions, actions))",
    )
    found = errors(direct)
    assert "extreme-actions" in found
    assert "random-actions" not in found


def test_constant_columns_finds_constant_column(managed):
    managed.terms = "def height(env) -> Tensor:\n    return torch.full((env.num_envs, 1), 0.75)\n"
    managed.config["observations"]["policy"]["height"] = {"func": "height"}
    finding = errors(managed)["constant-columns"]
    assert "column 2 (height)" in finding.where
    assert "0.75" in finding.message


def test_aliasing_finds_action_written_in_place(direct):
    direct.replace("self.arms.set_joint_efforts(self.params.max_effort * actions)",
                   "self.arms.set_joint_efforts(actions.mul_(self.params.max_effort))")  # fmt: skip
    assert errors(direct)["aliasing"].where == "the action"


# --- seeds, start states, ends ---


def test_same_seed_finds_torch_rand_in_reset(direct):
    direct.replace("self.draws(env_ids).uniform(-0.5, 0.5, (1,))", "torch.rand(len(env_ids), 1) - 0.5")
    found = errors(direct)
    assert "two new environments" in found["same-seed"].message
    assert "draws(env_ids)" in found["same-seed"].hint
    assert "partial-reset" not in found


def test_same_seed_finds_state_that_survives_reset(managed):
    managed.terms = """
class Travelled:
    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self._entity = entity
        self._sum = torch.zeros(env.num_envs)

    def __call__(self) -> Tensor:
        self._sum = self._sum + self._entity.data.joint_vel[:, 0].abs()
        return self._sum.clone()
"""
    managed.config["rewards"]["travelled"] = {"func": "travelled", "weight": -0.01}
    finding = errors(managed)["same-seed"]
    assert "after reset(seed)" in finding.message
    assert finding.where == "reward"


def test_start_states_finds_constant_start(managed):
    managed.config["events"]["start"]["position"] = [0.3, 0.3]
    found = [f for f in check(managed) if f.check == "start-states"]
    assert [f.where for f in found] == ["between environments", "between episodes"]


def test_start_states_finds_same_start_in_all_episodes(direct):
    direct.replace("self.draws(env_ids).uniform(-0.5, 0.5, (1,))", "0.05 * env_ids[:, None].float()")
    found = [f for f in check(direct) if f.check == "start-states"]
    assert [f.where for f in found] == ["between episodes"]


def test_partial_reset_finds_write_to_other_row(direct):
    direct.replace(
        "        self.arms.set_joint_positions(angle, indices=env_ids)",
        "        self.arms.set_joint_positions(angle, indices=env_ids)\n"
        "        self.arms.set_joint_velocities(torch.zeros(1, 1), indices=(env_ids[-1:] + 1) % self.num_envs)",
    )
    finding = errors(direct)["partial-reset"]
    assert "[6]" in finding.message
    assert "state" in finding.where


def test_partial_reset_finds_average_over_environments(managed):
    managed.terms = (
        "def relative(env, *, entity: Entity = 'robot') -> Tensor:\n"
        "    angle = entity.data.joint_pos[:, 0]\n    return angle - angle.mean()\n"
    )
    managed.config["rewards"]["relative"] = {"func": "relative", "weight": 1.0}
    assert errors(managed)["partial-reset"].where == "reward"


def test_final_observations_finds_stale_observation(direct):
    direct.replace(
        "    def get_observations(self):\n",
        "    def get_observations(self):\n"
        "        if getattr(self, 'seen', None) == self.env.common_step:\n            return\n"
        "        self.seen = self.env.common_step\n",
    )
    finding = errors(direct)["final-observations"]
    assert "[1, 4, 5]" in finding.message


def test_truncation_finds_missing_time_out(managed):
    managed.config["terminations"] = {}
    finding = errors(managed)["truncation"]
    assert "continue after step 6" in finding.message
    assert "time_out: true" in finding.hint


def test_truncation_finds_early_time_out(managed):
    managed.terms = "def soon(env) -> Tensor:\n    return env.episode_length_buf >= env.max_episode_length - 1\n"
    managed.config["terminations"]["time_out"] = {"func": "soon", "time_out": True}
    assert "1 step before its limit" in errors(managed)["truncation"].message


def test_termination_finds_undeclared_time_out(managed):
    managed.config["terminations"]["clock"] = {"func": "time_out"}
    finding = errors(managed)["termination"]
    assert finding.where == "terminations: clock"
    assert "at 6 and at 9 steps" in finding.message


def test_termination_finds_time_limit_in_is_done(direct):
    # the idiom of OmniIsaacGymEnvs' tasks
    direct.replace(
        "self.reset_buf[:] = self.obs_buf[:, 0].abs() > 3.0",
        "self.reset_buf[:] = self.progress_buf >= self.max_episode_length - 1",
    )
    finding = errors(direct)["termination"]
    assert "one step before their limit" in finding.message
    assert finding.where == "terminations: task"


def test_termination_warns_about_own_timer(direct):
    direct.replace("self.obs_buf[:, 0].abs() > 3.0", "self.progress_buf >= 40")
    (finding,) = check(direct)
    assert (finding.check, finding.severity) == ("termination", "warning")
    assert "exactly 40 steps" in finding.message


def test_replaced_reset_buf_is_accepted(direct):
    direct.replace("self.reset_buf[:] = self.obs_buf", "self.reset_buf = self.obs_buf")
    assert check(direct) == []


# --- repeated observations ---


def test_repeated_observation_finds_change_in_direct_task(direct):
    direct.replace(
        "self.obs_buf[:, 1] = self.arms.get_joint_velocities()[:, 0]",
        "self.obs_buf[:, 1] = self.obs_buf[:, 0] - getattr(self, 'last', 0.0)\n"
        "        self.last = self.obs_buf[:, 0].clone()",
    )
    assert errors(direct)["repeated-observation"].where == "obs_buf"


def test_repeated_observation_finds_stateful_term(managed):
    managed.terms = """
class Change:
    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self._entity, self._last = entity, entity.data.joint_pos.clone()

    def __call__(self) -> Tensor:
        change = self._entity.data.joint_pos - self._last
        self._last = self._entity.data.joint_pos.clone()
        return change

    def reset(self, selection) -> None:
        selection.write(self._last, 0.0)
"""
    managed.config["observations"]["policy"]["change"] = {"func": "change"}
    assert "observations.policy" in errors(managed)["repeated-observation"].where


def test_observation_after_reset_finds_changed_running_rows(direct):
    direct.replace(
        "self.obs_buf[:, 1] = self.arms.get_joint_velocities()[:, 0]",
        "self.obs_buf[:, 1] = self.obs_buf[:, 0] - self.obs_buf[:, 0].mean()",
    )
    finding = errors(direct)["observation-after-reset"]
    assert "[0, 2, 3, 6, 7]" in finding.message


def test_observation_after_reset_ignores_other_ended_episodes(direct):
    direct.replace("self.obs_buf[:, 0].abs() > 3.0", "self.obs_buf[:, 0].abs() > 0.3")
    assert "observation-after-reset" not in errors(direct)


# --- isolation ---


def test_raising_check_is_finding_and_others_run(direct):
    direct.replace(
        "    def reset_idx(self, env_ids):\n",
        "    def reset_idx(self, env_ids):\n        if 0 < len(env_ids) < 8:\n            raise KeyError('partial')\n",
    )
    direct.replace("self.draws(env_ids).uniform(-0.5, 0.5, (1,))", "torch.full((len(env_ids), 1), 0.1)")
    found = errors(direct)
    assert "KeyError: 'partial'" in found["finite"].message
    assert "task.py:" in found["finite"].where
    assert found["partial-reset"].hint == "first correct what the check finite reports: the error is the same"
    assert "start-states" in found


def test_task_that_cannot_be_built_is_one_finding(managed):
    managed.terms = "def broken(env) -> Tensor:\n    raise RuntimeError('no such thing')\n"
    managed.config["rewards"]["broken"] = {"func": "broken", "weight": 1.0}
    (finding,) = check(managed)
    assert "no such thing" in finding.message
    assert "terms.py:10" in finding.where


def test_check_task_keeps_random_state(managed):
    import torch

    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    check(managed)
    assert torch.equal(torch.rand(1), expected)


def test_progress_names_the_running_check(managed, monkeypatch):
    running: list[str] = []

    def observe(subject):
        running.extend(work.what for work in shown[0])
        return []

    shown = []
    monkeypatch.setattr(progress, "view", lambda works: shown.append(works) or contextlib.nullcontext())
    monkeypatch.setitem(CHECKS, "names", observe)
    check_task(managed.write(), only=["names"])
    assert running == ["checks", "names"]
