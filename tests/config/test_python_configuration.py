"""Configurations in Python: equal to the YAML form, terms as functions, messages."""

import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from rlcli.config.dump import to_data
from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.config.schema import (
    ActionConfig,
    DomeLightConfig,
    EntityConfig,
    EventConfig,
    GroundConfig,
    JointConfig,
    LightsConfig,
    ObservationConfig,
    RewardConfig,
    SceneConfig,
    SimConfig,
    SuccessConfig,
    TaskConfig,
    TerminationConfig,
    ViewerConfig,
)
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, TaskError
from rlcli.mdp import rewards
from rlcli.registry import find_task
from rlcli.task import Entity, Joints

torch.set_num_threads(1)
QUARTER = 0.785398163


def cart_vel(env, *, entity: Entity = "robot", joints: Joints = ".*", factor: float = 1.0):
    """Sum of absolute joint velocities [rad/s]. (num_envs,)"""
    return factor * entity.data.joint_vel[:, joints].abs().sum(dim=1)


def cartpole(**changes):
    """Return the task `cartpole` as a Python configuration without agents."""
    parts = {
        "summary": "Balance a pole on a cart (manager-based, Isaac Lab's parameters).",
        "sim": SimConfig(dt=1 / 120, render_interval=2),
        "decimation": 2,
        "episode_length_s": 5.0,
        "viewer": ViewerConfig(eye=(8.0, 0.0, 5.0), lookat=(0.0, 0.0, 2.0)),
        "scene": SceneConfig(
            num_envs=8,
            env_spacing=4.0,
            ground=GroundConfig(size=100.0),
            lights=LightsConfig(dome=DomeLightConfig(color=(0.9, 0.9, 0.9), intensity=500.0)),
            entities={
                "robot": EntityConfig(
                    model="cartpole.xml",
                    pos=(0.0, 0.0, 2.0),
                    joints={"slider_to_cart": JointConfig(damping=10.0, effort_limit=400.0)},
                )
            },
        ),
        "actions": {"joint_effort": ActionConfig(func="joint_effort", joints=["slider_to_cart"], scale=100.0)},
        "observations": {
            "policy": {
                "joint_pos_rel": ObservationConfig(func="joint_pos_rel"),
                "joint_vel_rel": ObservationConfig(func="joint_vel_rel"),
            }
        },
        "events": {
            "reset_cart": _reset("slider_to_cart", 1.0, 0.5),
            "reset_pole": _reset("cart_to_pole", QUARTER, QUARTER),
        },
        "rewards": {
            "alive": RewardConfig(func=rewards.is_alive, weight=1.0),
            "terminating": RewardConfig(func="is_terminated", weight=-2.0),
            "pole_pos": RewardConfig(
                func=rewards.joint_pos_target_l2, weight=-1.0, joints=["cart_to_pole"], target=0.0
            ),
            "cart_vel": RewardConfig(func="joint_vel_l1", weight=-0.01, joints=["slider_to_cart"]),
            "pole_vel": RewardConfig(func="joint_vel_l1", weight=-0.005, joints=["cart_to_pole"]),
        },
        "terminations": {
            "time_out": TerminationConfig(func="time_out", time_out=True),
            "cart_out_of_bounds": TerminationConfig(
                func="joint_pos_out_of_manual_limit", joints=["slider_to_cart"], bounds=(-3.0, 3.0)
            ),
        },
        "success": {"pole": SuccessConfig(func="joint_error", joints=["cart_to_pole"], at_most=0.1)},
        "play": {"scene": {"num_envs": 16}},
    }
    return TaskConfig(**(parts | changes))


def _reset(joint, position, velocity):
    return EventConfig(
        func="reset_joints_by_offset",
        mode="reset",
        joints=[joint],
        position=(-position, position),
        velocity=(-velocity, velocity),
    )


@pytest.fixture
def root(tmp_path):
    """Folder with the model of cartpole."""
    shutil.copy(find_task("cartpole").root / "cartpole.xml", tmp_path)
    return tmp_path


def test_python_cartpole_resolves_to_yaml_cartpole(root):
    from_yaml = to_data(resolve(find_task("cartpole"), flags={"scene.num_envs": 8}))
    from_python = to_data(resolve(source_of(cartpole(), root)))
    from_yaml.pop("agents")
    assert from_python == from_yaml


def test_python_cartpole_steps_are_bit_identical(root):
    ours = make_env(cartpole(), root=root, seed=7)
    other = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": 8}), seed=7)
    ours.reset(seed=7), other.reset(seed=7)
    actions = 4.0 * torch.randn(100, 8, 1, generator=torch.Generator().manual_seed(0))
    ended = 0
    for action in actions:
        a, b = ours.step(action), other.step(action)
        assert torch.equal(a.obs["policy"], b.obs["policy"])
        assert torch.equal(a.reward, b.reward)
        assert torch.equal(a.terminated, b.terminated)
        ended += int(a.terminated.sum())
    assert ended > 0  # resets were compared too


def test_function_is_term_with_checked_parameters(root):
    terms = {"own": RewardConfig(func=cart_vel, weight=1.0, joints="slider_to_cart", factor=3.0)}
    env = make_env(cartpole(rewards=terms), root=root)
    env.reset(seed=0)
    step = env.step(torch.ones(8, 1))
    velocity = env.entities["robot"].data.joint_vel[:, 0]
    assert torch.allclose(step.reward, 3.0 * velocity.abs() * env.step_dt)
    with pytest.raises(ConfigError, match=r"rewards\.own\.factor: expected a number, found 'much'"):
        make_env(cartpole(rewards={"own": RewardConfig(func=cart_vel, weight=1.0, factor="much")}), root=root)
    with pytest.raises(ConfigError, match="unknown key 'factr'; did you mean 'factor'"):
        make_env(cartpole(rewards={"own": RewardConfig(func=cart_vel, weight=1.0, factr=1.0)}), root=root)


def test_function_with_wrong_shape_is_reported_by_key(root):
    def column(env, *, entity: Entity = "robot"):
        return entity.data.joint_pos

    message = r"rewards\.own: 'column' returned a tensor of shape \(8, 2\); return a tensor of shape \(8,\)"
    with pytest.raises(ConfigError, match=message) as refusal:
        make_env(cartpole(rewards={"own": RewardConfig(func=column, weight=1.0)}), root=root)
    assert str(refusal.value).count("own") == 1


def test_functions_with_same_name_stay_separate(root):
    def other():
        def cart_vel(env):
            """Zero. (num_envs,)"""
            return torch.zeros(env.num_envs)

        return cart_vel

    terms = {"a": RewardConfig(func=cart_vel, weight=1.0), "b": RewardConfig(func=other(), weight=1.0)}
    resolved = resolve(source_of(cartpole(rewards=terms), root))
    assert [term.func for term in resolved.task.rewards.values()] == ["cart_vel", "cart_vel_2"]
    env = make_env(resolved)
    env.reset(seed=0)
    env.step(torch.ones(8, 1))
    sums = env.reward_manager._values
    assert sums[0].abs().min() > 0
    assert torch.equal(sums[1], torch.zeros(8))


def test_function_that_is_no_term_is_refused(root):
    def positional(env, factor: float):
        return factor

    def untyped(env, *, factor):
        return factor

    for term, said in (
        (positional, "must be keyword-only"),
        (untyped, "every parameter needs an annotation"),
        (abs, "source code of a term cannot be read"),
    ):
        with pytest.raises(ConfigError, match=said):
            make_env(cartpole(rewards={"own": RewardConfig(func=term, weight=1.0)}), root=root)


def write_task(root, body="TASK = cartpole()"):
    here = Path(__file__).read_text(encoding="utf-8")
    form = here[here.index("def cart_vel") : here.index("@pytest.fixture")]
    imports = here[here.index("from rlcli.config.dump") : here.index("torch.set_num_threads")]
    (root / "task.py").write_text(
        "import torch\n" + imports + "QUARTER = 0.785398163\n" + form + textwrap.dedent(body), encoding="utf-8"
    )


def test_folder_with_python_task_is_found(root):
    write_task(root)
    source = find_task(f"{root}")
    assert source.name == root.name
    assert resolve(source).task.decimation == 2
    again = find_task(f"{root / 'task.py'}:cartpole")  # a function that makes one is as good
    assert to_data(resolve(again)) == to_data(resolve(source))


def test_object_that_is_no_configuration_is_refused(root):
    write_task(root, "TASK = 3\nBROKEN = lambda: 1 / 0\n")
    with pytest.raises(ConfigError, match="expected a TaskConfig, found a value of type int"):
        resolve(find_task(str(root)))
    with pytest.raises(TaskError, match=r"ZeroDivisionError: division by zero \(.*task\.py"):
        resolve(find_task(f"{root / 'task.py'}:BROKEN"))
    with pytest.raises(TaskError, match="has no 'OTHER'"):
        resolve(find_task(f"{root / 'task.py'}:OTHER"))
    with pytest.raises(TaskError, match="there is no file"):
        find_task(f"{root / 'no.py'}:TASK")


def test_model_of_installed_task_by_task_name(root):
    entity = EntityConfig(model="cartpole:cartpole.xml")
    scene = SceneConfig(num_envs=2, entities={"robot": entity})
    assert make_env(cartpole(scene=scene), root=root).entities["robot"].joint_names == [
        "slider_to_cart",
        "cart_to_pole",
    ]
    for model, said in (("cartpol:cartpole.xml", "no task 'cartpol'"), ("cartpole:../index.json", "outside")):
        broken = SceneConfig(num_envs=2, entities={"robot": EntityConfig(model=model)})
        with pytest.raises(ConfigError, match=said):
            make_env(cartpole(scene=broken), root=root)


@pytest.mark.slow
def test_run_of_python_task_is_resumed_and_evaluated(root):
    agent = (
        'from rlcli.rl.ppo.config import PpoConfig\nTASK = cartpole(rewards={"own": RewardConfig(func=cart_vel,'
        ' weight=-0.1)}, agents={"ppo": PpoConfig(trainer="ppo", algorithm="ppo", max_iterations=2)})\n'
    )
    write_task(root, agent)

    def rlcli(*words):
        done = subprocess.run(
            [sys.executable, "-m", "rlcli", *words, "--runs-dir", str(root / "runs")], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    rlcli("train", str(root), "--device", "cpu", "--logger", "none")
    rlcli("train", "--resume", "latest", "--max-iterations", "3", "--device", "cpu")
    assert "success" in rlcli("eval", "--checkpoint", "latest", "--episodes", "4", "--num-envs", "4")
