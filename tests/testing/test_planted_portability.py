"""The checks of threads, sizes, engines, checkpoints, versions and speed find planted defects."""

import json
import shutil
from dataclasses import replace
from importlib.util import find_spec

import pytest

from rlcli.cli.app import main
from rlcli.registry import find_task
from rlcli.testing import check_task, record_layout, same_result_checks
from rlcli.testing.task_under_test import TaskUnderTest


def only(folder, *names):
    """Run some checks; return (findings, notes)."""
    notes = {}
    found = check_task(folder.write(), only=names, on_note=notes.__setitem__)
    assert all(f.check in names and f.where and f.message and f.hint for f in found)
    return found, notes


# --- threads and sizes ---


def test_threads_finds_dependence_on_engine_threads(direct):
    direct.replace("1.0 - self.obs_buf[:, 0].square()", "float(self.env.engine.threads)")
    ((finding,), _) = only(direct, "threads")
    assert (finding.severity, finding.where) == ("error", "reward")
    assert "1 and 3 engine threads" in finding.message


def test_num_envs_finds_dependence_on_number_of_environments(direct):
    direct.replace("1.0 - self.obs_buf[:, 0].square()", "self.obs_buf[:, 0] / self.num_envs")
    ((finding,), _) = only(direct, "num-envs")
    assert (finding.severity, finding.where) == ("error", "reward")
    assert "8 and 3 environments" in finding.message


def test_num_envs_warns_about_torch_draws(direct):
    direct.replace("self.draws(env_ids).uniform(-0.5, 0.5, (1,))", "torch.rand(len(env_ids), 1) - 0.5")
    ((finding,), _) = only(direct, "num-envs")
    assert finding.severity == "warning"
    assert "draws from torch" in finding.message


def test_num_envs_warns_about_averaging_curriculum(managed):
    managed.terms = """
class Harder:
    def __init__(self, env) -> None:
        self.level = torch.zeros(())

    def __call__(self, selection) -> Tensor:
        self.level += selection.count
        return self.level

    def state_dict(self):
        return {"level": self.level.clone()}

    def load_state_dict(self, state) -> None:
        self.level.copy_(state["level"])


def level(env) -> Tensor:
    return env.curriculum_manager.terms[0].instance.level.expand(env.num_envs).clone() if hasattr(
        env, "curriculum_manager") else torch.zeros(env.num_envs)
"""
    managed.config["curriculum"] = {"harder": {"func": "harder"}}
    managed.config["rewards"]["level"] = {"func": "level", "weight": 1.0}
    found, notes = only(managed, "num-envs", "checkpoint", "back-fill")
    assert [(f.check, f.severity) for f in found] == [("num-envs", "warning")]
    assert "curriculum" in found[0].message
    assert "curriculum" in notes["back-fill"]


# --- checkpoints and resets ---


HISTORY = """
from rlcli.envs.observers import StepObserver

class Seen(StepObserver):
    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self._entity = entity
        self._last = torch.zeros(env.num_envs, 1)
        env.observers.add(self)

    def after_physics(self) -> None:
        self._last.copy_(self._entity.data.joint_pos)

    def __call__(self) -> Tensor:
        return self._last.clone()
"""


def test_back_fill_finds_history_without_reset(managed):
    managed.terms = HISTORY
    managed.config["observations"]["policy"]["seen"] = {"func": "seen"}
    ((finding,), _) = only(managed, "back-fill")
    assert "column 2 (seen)" in finding.where
    assert "environment 1" in finding.message


def test_back_fill_accepts_history_with_reset(managed):
    managed.terms = HISTORY + (
        "\n    def reset(self, selection) -> None:\n"
        "        selection.write(self._last, selection.read(self._entity.data.joint_pos))\n"
    )
    managed.config["observations"]["policy"]["seen"] = {"func": "seen"}
    assert only(managed, "back-fill") == ([], {})


def test_configured_history_delay_and_noise_are_accepted(managed):
    managed.config["observations"]["policy"]["angle"] |= {
        "history": 3,
        "delay": {"steps": [0, 2], "redraw": 0.5},
        "noise": {"kind": "gaussian", "std": 0.1},
    }
    managed.config["commands"] = {
        "place": {"func": "uniform_pose2d", "resampling_time_s": [0.04, 0.1], "x": [0.0, 1.0], "y": [0.0, 1.0]}
    }
    managed.config["observations"]["policy"]["asked"] = {"func": "generated_commands", "command": "place"}
    managed.config["curriculum"] = {
        "weight": {"func": "interpolate", "address": "rewards.upright.weight", "end": 20, "to": -2.0}
    }
    assert only(managed, "checkpoint", "threads", "num-envs", "repeated-observation")[0] == []
    managed.config["curriculum"] = {}
    assert only(managed, "back-fill") == ([], {})


def test_back_fill_finds_direct_buffer_without_reset(direct):
    direct.replace(
        "    def pre_physics_step(self, actions):\n",
        "    def post_reset(self):\n        self.last = torch.zeros(self.num_envs)\n\n"
        "    def pre_physics_step(self, actions):\n        self.last.copy_(actions[:, 0])\n",
    )
    direct.replace("self.obs_buf[:, 1] = self.arms.get_joint_velocities()[:, 0]", "self.obs_buf[:, 1] = self.last")
    ((finding,), _) = only(direct, "back-fill")
    assert "obs_buf" in finding.where


def test_checkpoint_finds_unsaved_generator(managed):
    managed.terms = """
class Travelled:
    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self._entity = entity
        self.sums = self._summed(torch.zeros(env.num_envs))

    def _summed(self, sum):
        while True:
            sum = sum + self._entity.data.joint_vel[:, 0].abs()
            yield sum

    def __call__(self) -> Tensor:
        return next(self.sums)
"""
    managed.config["rewards"]["travelled"] = {"func": "travelled", "weight": -0.01}
    ((finding,), _) = only(managed, "checkpoint")
    assert finding.where == "reward"
    assert "no checkpoint can hold Travelled.sums (generator)" in finding.hint
    managed.path = managed.path.with_name("mended")
    managed.terms = managed.terms.replace(
        "return next(self.sums)",
        "self.sum = getattr(self, 'sum', 0.0) + self._entity.data.joint_vel[:, 0].abs()\n"
        "        return self.sum.clone()",
    )
    assert only(managed, "checkpoint") == ([], {})


def test_checkpoint_finds_incomplete_state_dict(managed):
    managed.terms = """
class Turn:
    def __init__(self, env) -> None:
        self.command = torch.zeros(env.num_envs, 1)
        self.rate = torch.zeros(env.num_envs, 1)

    def resample(self, selection) -> None:
        selection.write(self.rate, selection.uniform(0.5, 1.0, (1,)))

    def update(self) -> None:
        self.command += self.rate

    def reset(self, selection) -> None:
        selection.write(self.command, 0.0)

    def state_dict(self):
        return {"command": self.command.clone()}

    def load_state_dict(self, state) -> None:
        self.command.copy_(state["command"])
"""
    managed.config["commands"] = {"turn": {"func": "turn", "resampling_time_s": [9.0, 9.0]}}
    managed.config["observations"]["policy"]["asked"] = {"func": "generated_commands", "command": "turn"}
    ((finding,), _) = only(managed, "checkpoint")
    assert "asked" in finding.where


def test_checkpoint_finds_unsaved_mask_of_first_steps(managed):
    """After some steps the mask is true in every environment, before and after restoring."""
    managed.terms = """
class Jump:
    def __init__(self, env) -> None:
        self.started = torch.zeros(env.num_envs, dtype=torch.bool)

    def __call__(self):
        value = self.started.float()
        self.started[:] = True
        return value

    def reset(self, selection) -> None:
        selection.write(self.started, False)

    def state_dict(self):
        return {}

    def load_state_dict(self, state) -> None:
        pass
"""
    managed.config["rewards"]["jump"] = {"func": "jump", "weight": 1.0}
    ((finding,), _) = only(managed, "checkpoint")
    assert finding.where == "reward"


def test_checkpoint_finds_iterator_but_accepts_number(direct):
    direct.replace(
        "        self.rew_buf[:] = ",
        "        self.count = getattr(self, 'count', None) or iter(range(999))\n"
        "        self.rew_buf[:] = 0.01 * next(self.count) + ",
    )
    ((finding,), _) = only(direct, "checkpoint")
    assert "(range_iterator)" in finding.hint
    assert "of the task" in finding.hint
    direct.replace("getattr(self, 'count', None) or iter(range(999))", "getattr(self, 'count', 0) + 1")
    direct.replace("next(self.count)", "self.count")
    direct.path = direct.path.with_name("mended")
    assert only(direct, "checkpoint") == ([], {})


# --- versions ---


def test_layout_needs_recorded_file(managed):
    found, notes = only(managed, "layout")
    assert found == []
    assert "--record-layout" in notes["layout"]
    assert record_layout(managed.path).name == "task.layout.json"
    assert only(managed, "layout") == ([], {})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("order", "column 0 was 'angle[hinge]' and is 'rate[hinge]'"),
        ("gone", "the group had 2 columns and has 1; the first difference is column 1"),
        ("scale", "'rate': scale was [0.1] and is [0.2]"),
        ("group", "this group is new"),
    ],
)
def test_layout_finds_changed_observations(change, says, managed):
    record_layout(managed.write())
    groups = managed.config["observations"]
    if change == "order":
        groups["policy"] = dict(reversed(groups["policy"].items()))
    elif change == "gone":
        groups["policy"].pop("rate")
    elif change == "scale":
        groups["policy"]["rate"]["scale"] = 0.2
    else:
        groups["critic"] = {"angle": {"func": "joint_pos"}}
    ((finding,), _) = only(managed, "layout")
    assert (finding.severity, finding.message) == ("error", says)
    assert "task.layout.json" in finding.hint


def test_layout_finds_changed_actions(direct):
    file = record_layout(direct.write())
    direct.path = direct.path.with_name("later")
    file.rename(direct.write() / file.name)
    direct.replace("num_actions = 1", "num_actions = 2")
    direct.replace("self.params.max_effort * actions", "self.params.max_effort * actions[:, :1]")
    ((finding,), _) = only(direct, "layout")
    message = "the group had 1 columns and has 2; the first difference is column 1"
    assert (finding.where, finding.message) == ("actions", message)


@pytest.mark.parametrize("text", ["{", "[]", '{"observations": 3}'])
def test_layout_finds_invalid_file(text, managed):
    (managed.write() / "task.layout.json").write_text(text)
    ((finding,), _) = only(managed, "layout")
    assert "the file has no record of the columns" in finding.message


def test_command_records_layout(managed, capsys):
    folder = str(managed.write())
    assert main(["check", folder, "--only", "layout", "--record-layout"]) == 0
    assert "task.layout.json" in capsys.readouterr().err
    kept = json.loads((managed.path / "task.layout.json").read_text())
    assert [term["name"] for term in kept["observations"]["policy"]] == ["angle", "rate"]
    assert main(["check", folder, "--only", "layout", "observations.policy.rate.scale=3.0", "--json"]) == 9
    document = json.loads(capsys.readouterr().out)
    assert document["findings"][0]["check"] == "layout"


# --- speed ---


@pytest.mark.parametrize("where", ["reward", "reset"])
def test_speed_finds_python_loop_with_its_line(where, direct):
    if where == "reward":
        direct.replace(
            "        self.rew_buf[:] = 1.0 - self.obs_buf[:, 0].square()",
            "        for row in range(self.num_envs):\n            self.rew_buf[row] = 1.0 - self.obs_buf[row, 0] ** 2",
        )
    else:
        direct.replace(
            "        self.arms.set_joint_positions(angle, indices=env_ids)",
            "        for row in range(len(env_ids)):\n"
            "            self.arms.set_joint_positions(angle[row : row + 1], indices=env_ids[row : row + 1])",
        )
    ((finding,), notes) = only(direct, "speed")
    lines = direct.task.splitlines()
    line = int(finding.where.rpartition(":")[2])
    assert finding.where.startswith(str(direct.path / "task.py"))
    assert "row" in lines[line - 1]
    assert "16 environments" in finding.message
    assert "steps/s" in notes["speed"]


def test_speed_measures_few_steps_of_a_task_with_long_steps(direct, tmp_path):
    count = tmp_path / "steps"
    begin = "    def get_observations(self):\n"
    planted = f"        import time\n        time.sleep(0.4)\n        with open({str(count)!r}, 'a') as file:\n"
    planted += "            file.write('x')\n"
    direct.replace(begin, begin + planted)
    _, notes = only(direct, "speed")
    assert len(count.read_text()) < 20  # 30 with ten measured steps of 16 and of 256 environments
    assert "steps/s" in notes["speed"]


def test_speed_restores_trace_function(managed):
    import sys

    def trace(frame, event, value):
        return None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        only(managed, "speed")
        assert sys.gettrace() is trace
    finally:
        sys.settrace(before)


# --- the GPU's engine, on Warp's CPU device ---


needs_warp = pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="MuJoCo Warp comes with rlcli[gpu]")


@needs_warp
def test_correct_task_passes_engines_and_captured(managed):
    assert only(managed, "engines", "captured") == ([], {})


@needs_warp
def test_engines_finds_reset_for_cpu_only(managed):
    managed.terms = """
def start_at(env, selection, *, entity: Entity = "robot") -> None:
    entity.write_joint_positions(selection, 0.1 * torch.from_numpy(selection.ids)[:, None].float())
"""
    managed.config["events"]["at"] = {"func": "start_at", "mode": "reset"}
    found, _ = only(managed, "engines")
    assert [f.severity for f in found] == ["error"]
    assert "'ids'" in found[0].message
    assert "terms.py" in found[0].where
    managed.config["sim"]["engine"] = "batch"
    found, notes = only(managed, "engines", "captured")
    assert found == []
    assert "sim.engine: batch" in notes["engines"]


@needs_warp
def test_engines_finds_different_reward(managed):
    managed.terms = "def kind(env) -> Tensor:\n    return torch.full((env.num_envs,), float(env.engine.asynchronous))\n"
    managed.config["rewards"]["kind"] = {"func": "kind", "weight": 1.0}
    ((finding,), _) = only(managed, "engines")
    assert finding.message.startswith("reward is ")


@needs_warp
def test_captured_finds_host_sync_with_its_line(managed):
    managed.terms = (
        "def sign(env, *, entity: Entity = 'robot') -> Tensor:\n"
        "    angle = entity.data.joint_pos[:, 0]\n"
        "    return angle if float(angle.sum()) > 0.0 else -angle\n"
    )
    managed.config["rewards"]["sign"] = {"func": "sign", "weight": 1.0}
    ((finding,), _) = only(managed, "captured")
    assert finding.severity == "warning"
    assert finding.where.endswith("terms.py:11")
    assert "forces a host sync" in finding.message


@needs_warp
def test_captured_simulates_one_physics_step_for_each_environment_step(managed):
    managed.terms = (
        "def substeps(env, selection) -> None:\n"
        "    if env.engine.asynchronous and env.config.decimation > 1:\n"
        "        raise ValueError('slow')\n"
    )
    managed.config["decimation"] = 4
    managed.config["events"]["substeps"] = {"func": "substeps", "mode": "reset"}
    assert only(managed, "captured") == ([], {})


@needs_warp
def test_captured_is_not_run_for_reset_idx(direct):
    found, notes = only(direct, "engines", "captured")
    assert found == []
    assert "reset_idx takes ids" in notes["captured"]


@needs_warp
def test_engines_is_not_run_for_unsupported_model(managed):
    managed.xml = managed.xml.replace("</mujoco>", '<option solver="PGS"/></mujoco>')
    found, notes = only(managed, "engines")
    assert found == []
    assert "cannot run the model" in notes["engines"]


@pytest.fixture
def shipped(tmp_path):
    """Source of cartpole with a copy of its policy, and the folder of the copy."""
    source = find_task("cartpole")
    folder = shutil.copytree(source.policy, tmp_path / "policies" / "cartpole")
    return replace(source, policy=folder), folder


def edit_manifest(folder, change):
    document = json.loads((folder / "manifest.json").read_text())
    change(document)
    (folder / "manifest.json").write_text(json.dumps(document))


def test_policy_accepts_fitting_shipped_policy(shipped):
    assert list(same_result_checks.policy(TaskUnderTest(shipped[0]))) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["layout"].update(step_dt=0.02), "does not fit the installed task"),
        (lambda m: m["layout"]["observations"]["policy"].reverse(), "does not fit the installed task"),
        (lambda m: m.update(agent="nobody"), "nobody"),
        (lambda m: m["task"].update(name="cartpole-direct"), "has a policy for 'cartpole-direct'"),
        (lambda m: m["files"]["policy.safetensors"].update(sha256="0" * 64), "is corrupt"),
    ],
)
def test_policy_finds_misfit_of_shipped_policy(shipped, change, message):
    source, folder = shipped
    edit_manifest(folder, change)
    (finding,) = same_result_checks.policy(TaskUnderTest(source))
    assert finding.severity == "error"
    assert message in finding.message


def test_policy_is_not_run_without_shipped_policy(managed):
    found, notes = only(managed, "policy")
    assert found == []
    assert "--format bundle" in notes["policy"]


def test_recording_a_layout_replaces_a_link(managed, tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    file = managed.write() / "task.layout.json"
    file.symlink_to(victim)
    assert record_layout(managed.path) == file
    assert victim.read_text() == "precious"
    assert not file.is_symlink()
