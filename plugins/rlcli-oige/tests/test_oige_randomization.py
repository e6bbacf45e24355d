"""`domain_randomization:` with OmniIsaacGymEnvs' syntax."""

import pytest
import torch
import yaml as yaml_module
from reacher import TASK, YAML, arm_folder

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task

torch.set_num_threads(1)
IDLE = torch.zeros(4, 1)
# the robots do not move, so that episodes end only by time-out
STILL = TASK.replace("torch_rand_float(-0.1, 0.1,", "torch_rand_float(0.0, 0.0,").replace(
    "limit_of_the_angle()", "99.0"
)
STILL = STILL.replace("from rlcli_oige import 99.0\n", "")


def gate(operation, distribution, parameters, **more):
    return {"operation": operation, "distribution": distribution, "distribution_parameters": parameters, **more}


def folder(place, params, **more):
    block = {"domain_randomization": {"randomize": True, **more, "randomization_params": params}}
    return arm_folder(place / "arm", yaml=YAML + yaml_module.safe_dump(block), task=STILL)


def build(place, params, *overrides, seed=3, **more):
    env = make_env(resolve(find_task(str(folder(place, params, **more))), overrides=overrides), seed=seed)
    env.reset()
    return env


def arms(attribute, **gates):
    return {"articulation_views": {"arm_view": {attribute: gates}}}


def test_masses_are_sampled_per_episode_and_change_motion(tmp_path):
    env = build(
        tmp_path, {"rigid_prim_views": {"box_view": {"mass": {"on_reset": gate("scaling", "uniform", [0.5, 2.0])}}}}
    )
    masses = env.task._boxes.get_masses()
    assert ((masses > 1.5) & (masses < 6.0)).all()
    assert masses.unique().numel() == 4
    env.task._boxes.apply_forces(torch.tensor([[6.0, 0.0, 0.0]]).repeat(4, 1))
    env.forces_applied = False
    env.step(IDLE)
    assert torch.allclose(env.task._boxes.get_velocities()[:, 0], 6.0 * 0.02 / masses, rtol=1e-4)
    for _ in range(12):
        env.step(IDLE)
    assert (env.task._boxes.get_masses() != masses).all()


def test_on_reset_starts_from_on_startup_values(tmp_path):
    env = build(
        tmp_path,
        arms(
            "body_masses",
            on_startup=gate("direct", "uniform", [7.0, 7.0]),
            on_reset=gate("additive", "uniform", [1.0, 2.0]),
        ),
    )
    for _ in range(40):
        env.step(IDLE)
        masses = env.task._arms.get_body_masses()
        assert ((masses >= 8.0) & (masses <= 9.0)).all()


def test_on_interval_starts_from_on_reset_values(tmp_path):
    env = build(
        tmp_path,
        arms(
            "joint_armatures",
            on_reset=gate("direct", "uniform", [1.0, 1.0]),
            on_interval=gate("additive", "uniform", [0.1, 0.2], frequency_interval=3),
        ),
    )
    armature = env.engine.expand("dof_armature")[:, env.task._arms._dof_columns]
    assert (armature == 1.0).all()
    seen = []
    for _ in range(9):
        env.step(IDLE)
        seen.append(env.engine.expand("dof_armature")[:, env.task._arms._dof_columns].clone())
    assert torch.equal(seen[0], torch.ones_like(seen[0]))
    assert all(((s >= 1.1) & (s <= 1.2)).all() for s in seen[2:])
    assert torch.equal(seen[2], seen[4])
    assert not torch.equal(seen[2], seen[5])


def test_gravity_differs_between_envs_and_bodies_fall_by_it(tmp_path):
    gravity = {"gravity": {"on_reset": gate("additive", "gaussian", [[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])}}
    env = build(tmp_path, {"simulation": gravity})
    down = env.engine.expand("opt.gravity")[:, 2].float().clone()
    assert down.unique().numel() == 4
    env.step(IDLE)
    assert torch.allclose(env.task._boxes.get_velocities()[:, 2], down * 0.02, rtol=1e-4)


def test_episode_noise_stays_and_step_noise_skips_rewards(tmp_path):
    held = build(tmp_path / "held", {"observations": {"on_reset": gate("additive", "uniform", [1.0, 2.0])}})
    first = held.step(IDLE)
    noise = first.obs["policy"][:, 1].clone()
    assert ((noise > 0.9) & (noise < 2.1)).all()
    assert torch.allclose(held.step(IDLE).obs["policy"][:, 1], noise, atol=0.05)
    assert (first.reward == 100.0).all()
    fresh = build(
        tmp_path / "fresh",
        {"observations": {"on_interval": gate("additive", "gaussian", [0.0, 0.5], frequency_interval=1)}},
    )
    a, b = (fresh.step(IDLE).obs["policy"][:, 1].clone() for _ in range(2))
    assert (a - b).abs().max() > 0.1


def test_actions_get_noise(tmp_path):
    env = build(tmp_path, {"actions": {"on_interval": gate("additive", "uniform", [0.5, 0.5], frequency_interval=1)}})
    env.step(IDLE)
    env.step(IDLE)
    assert torch.allclose(env.task._arms.get_applied_joint_efforts()[:, 0], torch.full((4,), 1.0))  # 0.5 of 2 N m


def test_schedule_increases_strength(tmp_path):
    at = gate("scaling", "uniform", [3.0, 3.0], frequency_interval=1, schedule="linear", schedule_steps=8)
    env = build(tmp_path, arms("joint_armatures", on_startup=gate("direct", "uniform", [1.0, 1.0]), on_interval=at))
    seen = []
    for _ in range(10):
        env.step(IDLE)
        seen.append(float(env.engine.expand("dof_armature")[0, 0]))
    assert seen == pytest.approx([1 + 2 * min(1.0, step / 8) for step in range(1, 11)])


def test_task_can_change_distribution_parameters(tmp_path):
    path = ("articulation_views", "arm_view", "joint_armatures", "on_interval")
    env = build(
        tmp_path, arms("joint_armatures", on_interval=gate("direct", "uniform", [1.0, 1.0], frequency_interval=1))
    )
    randomizer = env.task._dr_randomizer
    assert randomizer.get_initial_dr_distribution_parameters(*path).tolist() == [1.0, 1.0]
    randomizer.set_dr_distribution_parameters([4.0, 4.0], *path)
    env.step(IDLE)
    assert float(env.engine.expand("dof_armature")[0, 0]) == 4.0
    assert randomizer.get_dr_distribution_parameters(*path) == [4.0, 4.0]
    assert randomizer.get_initial_dr_distribution_parameters(*path).tolist() == [1.0, 1.0]


def test_samples_do_not_depend_on_num_envs(tmp_path):
    params = arms("body_masses", on_reset=gate("scaling", "loguniform", [0.5, 2.0]))
    few, many = build(tmp_path / "few", params), build(tmp_path / "many", params, "scene.num_envs=9")
    assert torch.equal(few.task._arms.get_body_masses(), many.task._arms.get_body_masses()[:4])


def test_short_episodes_keep_samples_until_min_frequency(tmp_path):
    params = arms("joint_armatures", on_reset=gate("direct", "uniform", [1.0, 2.0]))
    env = build(tmp_path, params, min_frequency=15)
    first = env.engine.expand("dof_armature")[:, 0].clone()
    for _ in range(11):
        env.step(IDLE)
    assert torch.equal(env.engine.expand("dof_armature")[:, 0], first)
    for _ in range(11):
        env.step(IDLE)
    assert not torch.equal(env.engine.expand("dof_armature")[:, 0], first)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (arms("body_massses", on_reset=gate("scaling", "uniform", [1, 2])), "did you mean 'body_masses'"),
        (arms("damping", on_resett=gate("scaling", "uniform", [1, 2])), "unknown key 'on_resett'"),
        (arms("damping", on_reset=gate("scale", "uniform", [1, 2])), "unknown operation 'scale'"),
        (arms("damping", on_reset=gate("scaling", "unifrom", [1, 2])), "did you mean 'uniform'"),
        (arms("damping", on_reset=gate("scaling", "uniform", [2, 1])), "a lower bound is above its upper bound"),
        (arms("damping", on_reset=gate("scaling", "loguniform", [0, 1])), "needs bounds above 0"),
        (arms("damping", on_interval=gate("scaling", "uniform", [1, 2])), "missing keys: frequency_interval"),
        (
            {"observations": {"on_reset": gate("direct", "uniform", [1, 2])}},
            "expected additive or scaling for noise of observations, found direct",
        ),
        ({"simulation": {"dt": {"on_reset": gate("direct", "uniform", [1, 2])}}}, "'dt' cannot be randomised"),
    ],
)
def test_invalid_randomization_error_has_key(tmp_path, params, message):
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(str(folder(tmp_path, params))))
    assert message in str(caught.value)
    assert "Arm.yaml:" in str(caught.value)


def test_unregistered_view_error_lists_views(tmp_path):
    params = {"articulation_views": {"arms_view": {"damping": {"on_reset": gate("scaling", "uniform", [1, 2])}}}}
    with pytest.raises(ConfigError, match="the task registers no view 'arms_view'; did you mean 'arm_view'"):
        build(tmp_path, params)
