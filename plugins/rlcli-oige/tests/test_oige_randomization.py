"""`domain_randomization:` by OmniIsaacGymEnvs' grammar."""

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
# the robots are held still, so that episodes end by time alone
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


def test_masses_are_drawn_for_an_episode_and_are_felt(tmp_path):
    env = build(
        tmp_path, {"rigid_prim_views": {"box_view": {"mass": {"on_reset": gate("scaling", "uniform", [0.5, 2.0])}}}}
    )
    masses = env.task._boxes.get_masses()
    assert ((masses > 1.5) & (masses < 6.0)).all()
    assert masses.unique().numel() == 4
    env.task._boxes.apply_forces(torch.tensor([[6.0, 0.0, 0.0]]).repeat(4, 1))
    env.pushed = False
    env.step(IDLE)
    assert torch.allclose(env.task._boxes.get_velocities()[:, 0], 6.0 * 0.02 / masses, rtol=1e-4)
    for _ in range(12):
        env.step(IDLE)
    assert (env.task._boxes.get_masses() != masses).all()


def test_on_startup_holds_for_ever_and_on_reset_starts_from_it_each_time(tmp_path):
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


def test_on_interval_acts_on_top_of_on_reset_and_does_not_add_up(tmp_path):
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


def test_gravity_differs_between_environments_and_things_fall_by_it(tmp_path):
    gravity = {"gravity": {"on_reset": gate("additive", "gaussian", [[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])}}
    env = build(tmp_path, {"simulation": gravity})
    down = env.engine.expand("opt.gravity")[:, 2].float().clone()
    assert down.unique().numel() == 4
    env.step(IDLE)
    assert torch.allclose(env.task._boxes.get_velocities()[:, 2], down * 0.02, rtol=1e-4)


def test_noise_of_an_episode_stays_and_noise_of_steps_does_not_reach_rewards(tmp_path):
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


def test_actions_get_their_noise(tmp_path):
    env = build(tmp_path, {"actions": {"on_interval": gate("additive", "uniform", [0.5, 0.5], frequency_interval=1)}})
    env.step(IDLE)
    env.step(IDLE)
    assert torch.allclose(env.task._arms.get_applied_joint_efforts()[:, 0], torch.full((4,), 1.0))  # 0.5 of 2 N m


def test_a_schedule_lets_it_grow(tmp_path):
    at = gate("scaling", "uniform", [3.0, 3.0], frequency_interval=1, schedule="linear", schedule_steps=8)
    env = build(tmp_path, arms("joint_armatures", on_startup=gate("direct", "uniform", [1.0, 1.0]), on_interval=at))
    seen = []
    for _ in range(10):
        env.step(IDLE)
        seen.append(float(env.engine.expand("dof_armature")[0, 0]))
    assert seen == pytest.approx([1 + 2 * min(1.0, step / 8) for step in range(1, 11)])


def test_a_task_may_change_the_parameters(tmp_path):
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


def test_what_an_environment_draws_does_not_depend_on_how_many_there_are(tmp_path):
    params = arms("body_masses", on_reset=gate("scaling", "loguniform", [0.5, 2.0]))
    few, many = build(tmp_path / "few", params), build(tmp_path / "many", params, "scene.num_envs=9")
    assert torch.equal(few.task._arms.get_body_masses(), many.task._arms.get_body_masses()[:4])


def test_a_short_episode_keeps_what_was_drawn_until_min_frequency(tmp_path):
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
        (arms("damping", on_reset=gate("scale", "uniform", [1, 2])), "no operation 'scale'"),
        (arms("damping", on_reset=gate("scaling", "unifrom", [1, 2])), "did you mean 'uniform'"),
        (arms("damping", on_reset=gate("scaling", "uniform", [2, 1])), "a lower end is above its upper end"),
        (arms("damping", on_reset=gate("scaling", "loguniform", [0, 1])), "lies above 0"),
        (arms("damping", on_interval=gate("scaling", "uniform", [1, 2])), "needs frequency_interval"),
        ({"observations": {"on_reset": gate("direct", "uniform", [1, 2])}}, "noise is additive or scaling"),
        ({"simulation": {"dt": {"on_reset": gate("direct", "uniform", [1, 2])}}}, "'dt' cannot be randomised"),
    ],
)
def test_what_the_grammar_does_not_know_is_refused_with_its_place(tmp_path, params, message):
    with pytest.raises(ConfigError) as caught:
        resolve(find_task(str(folder(tmp_path, params))))
    assert message in str(caught.value)
    assert "Arm.yaml:" in str(caught.value)


def test_a_view_that_is_not_registered_is_named_with_those_that_are(tmp_path):
    params = {"articulation_views": {"arms_view": {"damping": {"on_reset": gate("scaling", "uniform", [1, 2])}}}}
    with pytest.raises(ConfigError, match="no view 'arms_view' is registered by the task; did you mean 'arm_view'"):
        build(tmp_path, params)
