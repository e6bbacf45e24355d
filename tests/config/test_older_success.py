"""Runs that were saved before `success` had named conditions are still evaluated."""

import pytest

from rlcli.config.load import resolve
from rlcli.errors import ConfigError
from rlcli.registry import find_task, folder_task


def task_with(tmp_path, name, success):
    task = find_task("cartpole")
    text = task.config.read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("success:")]
    (tmp_path / name).write_text("\n".join([*lines, f"success: {success}"]), encoding="utf-8")
    return folder_task(tmp_path, name)


@pytest.mark.parametrize(
    ("earlier", "conditions"),
    [
        (
            "{func: joints_near, joints: [cart_to_pole], target: 0.0, tolerance: 0.1, hold_s: 2.0}",
            {"joint": ("joint_error", None, 0.1)},
        ),
        (
            "{func: root_upright, limit_angle: 0.3, minimum_height: 0.2, hold_s: 2.0}",
            {"tilt": ("root_tilt", None, 0.3), "height": ("root_height", 0.2, None)},
        ),
        ("{func: root_upright, limit_angle: 0.3, hold_s: 2.0}", {"tilt": ("root_tilt", None, 0.3)}),
        (
            "{func: root_moves, direction: [0.0, 1.0, 0.0], speed: 0.5, limit_angle: 0.4, hold_s: 2.0}",
            {"velocity": ("root_velocity", 0.5, None), "tilt": ("root_tilt", None, 0.4)},
        ),
    ],
)
def test_run_of_an_earlier_version_has_the_same_conditions(tmp_path, earlier, conditions):
    found = resolve(task_with(tmp_path, "config.yaml", earlier)).task.success
    assert {n: (c.func, c.at_least, c.at_most) for n, c in found.items()} == conditions
    assert {c.hold_s for c in found.values()} == {2.0}


def test_task_file_needs_names(tmp_path):
    with pytest.raises(ConfigError, match="a term needs a name"):
        resolve(task_with(tmp_path, "task.yaml", "{func: joints_near, tolerance: 0.1}"))
