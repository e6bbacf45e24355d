"""Tests of policies with a CNN over images, from training to the exported file."""

import json
import runpy
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from pydantic import ValidationError
from torch import nn

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.rl.cnn import Cnn, CnnSpec, WideConv
from rlcli.rl.policy import PolicySpec
from rlcli.rl.ppo.trainer import PpoTrainer
from rlcli.runs.checkpoint_reader import open_checkpoint

MODEL = """
<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="0 1 0" damping="20"/>
  <geom type="sphere" size="0.3" contype="0" conaffinity="0" mass="1"/></body></worldbody></mujoco>
"""
YAML = """
summary: Push in the direction of the cart; only the image shows its position.
decimation: 1
episode_length_s: 0.05
sim: {dt: 0.01, gravity: [0, 0, 0]}
scene:
  num_envs: 16
  ground: null
  entities: {robot: {model: model.xml}}
  sensors:
    camera: {kind: camera, data: distance, width: 16, height: 8, samples: 2, eye: [-3, 0, 0], lookat: [0, 0, 0]}
actions: {push: {func: joint_effort}}
observations:
  policy:
    action: {func: last_action}
    image: {func: image, sensor: camera, history: 2, modifiers: [{kind: scale, factor: 0.3}]}
    time: {func: current_time_s}
events: {start: {func: reset_joints_by_offset, mode: reset, position: [-1.0, 1.0]}}
rewards: {way: {func: way, weight: 100.0}}
terminations: {time_out: {func: time_out, time_out: true}}
agents:
  ppo: {trainer: ppo, algorithm: ppo, max_iterations: 2, num_steps: 10, num_minibatches: 2, num_epochs: 2,
        cnn: {channels: [4, 6], kernels: [4, 2], strides: [2, 1], motion: 5.0},
        actor: {hidden: [8]}, critic: {hidden: [9]}}
"""
TERMS = '''
def way(env):
    """1 where the action has the direction of the cart position. (num_envs,)"""
    return (env.action_manager.action[:, 0].sign() == env.entities["robot"].data.joint_pos[:, 0].sign()).float()
'''
STATE = "\n  critic: {pos: {func: joint_pos}}\nevents"


@pytest.fixture
def image_task(tmp_path: Path) -> str:
    """A task whose agent has a CNN."""
    folder = tmp_path / "image_task"
    folder.mkdir()
    for name, text in (("task.yaml", YAML), ("model.xml", MODEL), ("terms.py", TERMS)):
        (folder / name).write_text(text)
    return str(folder)


@pytest.fixture
def make_trainer(image_task):
    made = []

    def make(*overrides, seed=5, env_seed=3, text=None):
        if text is not None:
            (Path(image_task) / "task.yaml").write_text(text)
        resolved = resolve(find_task(image_task), agent="ppo", overrides=overrides)
        env = make_env(resolved, seed=env_seed)
        made.append(env)
        trainer = PpoTrainer(env, resolved.agent, seed=seed, device="cpu", torch_threads=1)
        trainer.start()
        return trainer

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize(
    ("channels", "height", "width", "outputs", "edge", "step"),
    [(1, 5, 5, 1, 5, 1), (3, 7, 11, 4, 3, 2), (2, 6, 4, 3, 4, 3), (4, 9, 8, 2, 1, 1), (2, 10, 13, 5, 2, 4)],
)
def test_wide_conv_matches_torch_in_float64(channels, height, width, outputs, edge, step):
    mine = WideConv(channels, outputs, edge, step)
    theirs = nn.Conv2d(channels, outputs, edge, step).double()
    theirs.load_state_dict({name: value.double() for name, value in mine.state_dict().items()})
    picture = torch.randn(3, channels, height, width)
    torch.testing.assert_close(mine(picture), theirs(picture.double()), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("wide", [False, True])
def test_vision_outputs_image_features_then_other_columns(wide):
    pictures = [{"start": 1, "shape": [2, 3, 4]}, {"start": 27, "shape": [1, 2, 2]}]
    spec = CnnSpec(pictures=pictures, channels=[3], kernels=[2], strides=[1])
    vision, obs = Cnn(spec, nn.ReLU, wide=wide), torch.randn(5, 33)
    seen = vision(obs)
    assert seen.shape == (5, spec.features(33)) == (5, 3 * 2 * 3 + 3 + 5)
    first = torch.relu(vision.pictures[0][0](obs[:, 1:25].reshape(5, 2, 3, 4))).flatten(1)
    second = torch.relu(vision.pictures[1][0](obs[:, 27:31].reshape(5, 1, 2, 2))).flatten(1)
    others = obs[:, [0, 25, 26, 31, 32]].to(seen.dtype)
    torch.testing.assert_close(seen, torch.cat([first, second, others], dim=1))


def test_motion_replaces_older_images_by_differences():
    spec = CnnSpec(
        pictures=[{"start": 0, "shape": [6, 2, 3], "steps": 3}], channels=[5], kernels=[2], strides=[1], motion=4.0
    )
    vision, obs = Cnn(spec, nn.Identity), torch.randn(4, 36)
    plain = Cnn(spec.model_copy(update={"motion": None}), nn.Identity)
    plain.load_state_dict(vision.state_dict())
    first, second, now = obs.view(4, 3, 12).unbind(1)
    torch.testing.assert_close(vision(obs), plain(torch.cat([4.0 * (now - first), 4.0 * (now - second), now], dim=1)))


def test_layout_and_policy_spec_describe_image_columns(make_trainer):
    trainer = make_trainer()
    (action, image, time) = trainer.env.layout.observations["policy"]
    assert (image.shape, image.history, image.size) == ((1, 8, 16), 2, 256)
    assert (action.shape, time.shape) == ((), ())
    assert trainer.spec.kind == "gaussian-cnn"
    (picture,) = trainer.spec.vision.pictures
    assert (picture.start, picture.shape) == (1, (2, 8, 16))  # after one column; two steps are two channels
    assert (picture.steps, trainer.spec.vision.motion) == (2, 5.0)
    record = trainer.env.layout.record()["observations"]["policy"]
    assert [term.get("shape") for term in record] == [None, [1, 8, 16], None]


def test_history_channels_start_with_oldest_step(make_trainer):
    env = make_trainer().env
    env.reset(seed=1)
    before = env.step(torch.ones(16, 1)).obs["policy"][:, 1:257].unflatten(1, (2, 8, 16)).clone()
    after = env.step(torch.ones(16, 1)).obs["policy"][:, 1:257].unflatten(1, (2, 8, 16))
    assert torch.equal(after[:, 0], before[:, 1])
    assert not torch.equal(after[:, 1], before[:, 1])
    torch.testing.assert_close(after[:, 1], 0.3 * env.sensors["camera"].image[..., 0], rtol=1e-6, atol=1e-6)


def test_saved_policy_matches_learner(make_trainer):
    trainer = make_trainer("agent.action_bound=null")
    trainer.iterate()
    with torch.no_grad():
        mean = trainer.networks.mean(trainer.collector.obs["policy"])
    policy = trainer.policy()
    torch.testing.assert_close(policy(trainer.collector.obs["policy"]), mean, rtol=1e-4, atol=1e-5)
    one_by_one = torch.cat([policy(row[None]) for row in trainer.collector.obs["policy"]])
    assert torch.equal(one_by_one, policy(trainer.collector.obs["policy"]))


def test_image_changes_the_action(make_trainer):
    """The gradient reaches the first convolution."""
    networks = make_trainer().networks
    obs = torch.rand(4, 258)
    changed = obs.clone()
    changed[:, 100] += 1.0
    assert (networks.mean(obs) - networks.mean(changed)).abs().min() > 0.0
    networks.mean(obs).sum().backward()
    assert networks.vision.pictures[0][0].weight.grad.abs().sum() > 0.0


def test_actor_and_critic_have_separate_cnns_only_for_images(make_trainer):
    both = make_trainer()
    assert both.networks.critic_vision is not None
    assert not torch.equal(
        both.networks.vision.pictures[0][0].weight, both.networks.critic_vision.pictures[0][0].weight
    )
    state = make_trainer(text=YAML.replace("\nevents", STATE))
    assert state.networks.critic_vision is None
    assert state.networks.critic[0].in_features == 1
    assert state.networks.vision is not None


def test_critic_reads_images_and_states(make_trainer):
    trainer = make_trainer("agent.critic_obs=[critic,policy]", text=YAML.replace("\nevents", STATE))
    (picture,) = trainer.networks.critic_vision.spec.pictures
    assert picture.start == 1 + 1
    trainer.iterate()


@pytest.mark.parametrize(("critic", "tell"), [("", 0.0), (STATE, 0.0), (STATE, 0.5)])
def test_state_restores_bit_for_bit(make_trainer, critic, tell):
    text = YAML.replace("\nevents", critic) if critic else YAML
    trainer = make_trainer("agent.normalize_observations=true", f"agent.tell_coef={tell}", text=text)
    trainer.iterate()
    state = trainer.state()
    trainer.iterate()
    after = trainer.state()
    other = make_trainer("agent.normalize_observations=true", f"agent.tell_coef={tell}", seed=98, env_seed=99)
    other.load(state)
    other.iterate()
    for part, tensors in after.tensors.items():
        for name, value in tensors.items():
            assert torch.equal(value.nan_to_num(), other.state().tensors[part][name].nan_to_num()), (part, name)


@pytest.mark.slow
def test_tell_coef_teaches_actor_the_cart_position(make_trainer):
    trainer = make_trainer(
        "agent.tell_coef=1.0", "agent.learning_rate=2e-3", "agent.num_epochs=5", text=YAML.replace("\nevents", STATE)
    )
    for _ in range(30):
        trainer.iterate()
    networks, obs = trainer.networks, trainer.collector.obs
    with torch.no_grad():
        predicted = networks.teller(networks.hidden(obs["policy"]))[:, 0]
    assert torch.corrcoef(torch.stack([predicted, obs["critic"][:, 0]]))[0, 1] > 0.9
    assert not any("teller" in name for name in trainer.state().tensors["policy"])


@pytest.mark.slow
def test_policy_learns_from_images(make_trainer):
    """The reward is 1 for the right direction, which is random: 0.5 without the image."""
    trainer = make_trainer(
        "agent.max_iterations=40", "agent.learning_rate=3e-3", "agent.gamma=0.0", "agent.num_epochs=5"
    )
    for _ in range(40):
        trainer.iterate()
    policy, right = trainer.policy(), []
    obs = trainer.env.reset(seed=77)["policy"]
    for _ in range(10):
        result = trainer.env.step(policy(obs))
        obs = result.obs["policy"]
        right.append(result.reward.mean().item())  # 100 x dt x share
    assert sum(right) / len(right) > 0.9


@pytest.mark.parametrize(
    ("overrides", "fragment"),
    [
        (["agent.cnn.kernels=[9,2]"], "the kernel of layer 0 (9 x 9 pixels) is larger than its input (8 x 16 pixels)"),
        (["agent.cnn.kernels=[8,2]"], "the kernel of layer 1 (2 x 2 pixels) is larger than its input (1 x 5 pixels)"),
        (["agent.cnn.channels=[4]"], "must have one number for each layer"),
        (["agent.rnn={hidden: 4}"], "cnn and rnn cannot be combined"),
        (["observations.policy.image=null"], "no term of the observation group 'policy' is an image"),
    ],
)
def test_invalid_cnn_settings_are_config_errors(make_trainer, overrides, fragment):
    with pytest.raises(ConfigError) as refused:
        make_trainer(*overrides)
    assert fragment in str(refused.value.problems)


GOOD = {
    "kind": "gaussian-cnn",
    "observation_size": 20,
    "action_size": 1,
    "hidden": [4],
    "activation": "elu",
    "action_bound": 1.0,
    "vision": {"pictures": [{"start": 2, "shape": [1, 4, 4]}], "channels": [2], "kernels": [2], "strides": [2]},
}


@pytest.mark.parametrize(
    "change",
    [
        {"pictures": [{"start": 8, "shape": [1, 4, 4]}]},  # beyond the observation
        {"pictures": [{"start": 0, "shape": [1, 3, 3]}, {"start": 4, "shape": [1, 3, 3]}]},  # overlapping
        {"pictures": []},
        {"pictures": [{"start": 2, "shape": [3, 2, 2], "steps": 2}]},  # half a step
        {"motion": 0.0},
        {"kernels": [5]},
        {"strides": [0]},
        {"channels": [2, 2]},
    ],
)
def test_policy_spec_refuses_invalid_vision(change):
    PolicySpec.model_validate(GOOD)
    with pytest.raises(ValidationError):
        PolicySpec.model_validate({**GOOD, "vision": {**GOOD["vision"], **change}})
    with pytest.raises(ValidationError):
        PolicySpec.model_validate({**GOOD, "vision": None})


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        capfd.readouterr()
        code = main([*arguments, "--json"])
        return code, json.loads(capfd.readouterr().out)

    return run


@pytest.mark.slow
def test_image_run_is_resumed_bit_for_bit_evaluated_and_played(image_task, command, tmp_path):
    _, whole = command("train", image_task, "--runs-dir", "whole", "--logger", "none", "--max-iterations", "4")
    _, parts = command("train", image_task, "--runs-dir", "parts", "--logger", "none", "--max-iterations", "2")
    code, parts = command("train", "--resume", parts["run"], "--max-iterations", "4")
    assert (code, parts["iteration"]) == (0, 4)
    for file in ("policy.safetensors", "trainer.safetensors"):
        one, other = (open_checkpoint(Path(done["checkpoint"])).manifest["files"][file] for done in (whole, parts))
        assert one == other
    assert command("eval", "--checkpoint", parts["run"], "--episodes", "16")[0] == 0
    assert command("play", "--checkpoint", parts["run"], "--viewer", "none")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("activation", ["elu", "relu", "silu", "tanh"])
def test_exported_image_policies_match(image_task, command, tmp_path, activation):
    overrides = [f"agent.actor.activation={activation}", "agent.normalize_observations=true"]
    _, done = command(
        "train", image_task, *overrides, "--runs-dir", "runs", "--logger", "none", "--max-iterations", "1"
    )
    obs = torch.rand(5, 258)
    expected = open_checkpoint(Path(done["checkpoint"])).policy()(obs).numpy()
    for format_, suffix in (("onnx", "onnx"), ("numpy", "py"), ("torch", "pt2")):
        file = tmp_path / f"policy.{suffix}"
        to = ("--format", format_, "--output", str(file), "--verify")
        code, fragment = command("export", "--checkpoint", done["run"], *to)
        assert code == 0, fragment
        assert [term["shape"] for term in fragment["metadata"]["observations"]] == [[], [1, 8, 16], []]
        if format_ == "onnx":
            found = onnxruntime.InferenceSession(str(file)).run(["action"], {"obs": obs.numpy()})[0]
        elif format_ == "numpy":
            found = runpy.run_path(str(file))["run"]({"obs": obs.numpy()})["action"]
        else:
            found = torch.export.load(file).module()(obs)["action"].numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
