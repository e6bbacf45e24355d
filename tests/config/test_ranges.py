"""Ranges of numbers: quotients of keys, such as the number of steps of an episode, stay finite 64-bit integers."""

from pathlib import Path

import pytest

from rlcli.config.load import resolve
from rlcli.config.schema.terrain import TerrainGeneratorConfig
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.scene.terrain import terrain_problems


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sim.dt=1e-300", "sim.dt: 1e-300 is out of range; allowed: 1e-09 to 0.1"),
        ("episode_length_s=1e300", "episode_length_s: 1e+300 is out of range; allowed: 0 to 1e+09"),
        ("decimation=9223372036854775807", "decimation: 9223372036854775807 is out of range; allowed: 1 to 2147483647"),
        ("success.pole.hold_s=1e30", "hold_s: 1e+30 is out of range; allowed: 0 to 1e+09"),
        ("sim.iterations=4294967296", "sim.iterations: 4294967296 is out of range; allowed: 1 to 2147483647"),
        ("agent.max_iterations=9999999999999999999", "max_iterations: 9999999999999999999 is out of range"),
        ("agent.max_steps=9999999999999999999", "max_steps: 9999999999999999999 is out of range"),
        ("rewards.alive.weight=1e39", "weight: 1e+39 is out of range; allowed: -1e+38 to 1e+38"),
        ("scene.ground.size=1e-300", "1e-300 is out of range; allowed: 1e-38 to 1e+38"),
        (
            "scene.sensors.scan={kind: rays, pattern: {size: [1.0, 1.0], resolution: 1e-30}}",
            "the grid has more than 1,000,000 rays; give a larger resolution or a smaller size",
        ),
        (
            "events.push={func: push_by_setting_velocity, mode: interval, interval_range_s: [1e20, 1e20]}",
            "interval_range_s.0: 1e+20 is out of range; allowed: 0 to 1e+09",
        ),
    ],
)
def test_number_that_overflows_a_quotient_is_refused(override, message):
    with pytest.raises(ConfigError) as caught:
        resolve(find_task("cartpole"), overrides=[override])
    assert message in str(caught.value)


def test_episode_without_a_practical_end_is_allowed():
    task = resolve(find_task("cartpole"), overrides=["episode_length_s=1e9", "sim.dt=1e-9", "decimation=1"]).task
    assert task.max_episode_length == 10**18


def test_terrain_patch_of_too_many_parts_is_refused():
    patches = {"spacing": "noise", "step_width": "stairs", "cell": "grid"}
    for key, kind in patches.items():
        patch = {"kind": kind, key: 1e-30, **({"boxes": True} if kind != "noise" else {})}
        data = {"kind": "generator", "patch": (8.0, 8.0), "sub_terrains": {"it": patch}}
        config = TerrainGeneratorConfig.model_validate(data)
        found = [(where[-1], message) for where, message, _ in terrain_problems(config, Path())]
        assert found == [(key, f"a {key} of 1e-30 m divides a patch of 8 m into more than 2000 parts")]
