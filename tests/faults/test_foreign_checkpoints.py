"""Import of policies of Stable-Baselines3 and RSL-RL: equal actions."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy
import torch
from rsl_rl.runners import OnPolicyRunner
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support.fault_sizes import chosen
from support.foreign_checkpoints import (
    ALGORITHMS,
    OBSERVATIONS,
    ROWS,
    Still,
    close,
    imported,
    observations,
    old_rsl_rl_checkpoint,
    read,
    refused_by_command,
    sb3_file,
)
from tensordict import TensorDict

from rlcli.adapters.rsl_rl import RslRlVecEnv
from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.runs.checkpoint_reader import open_checkpoint

pytestmark = pytest.mark.usefixtures("nothing_executed")


@pytest.mark.parametrize(("name", "hidden"), chosen([(n, h) for h in ([32, 16, 8], [8], []) for n in ALGORITHMS], 4))
def test_sb3_policy_gives_the_same_actions(name, hidden):
    if not hidden and name == "sac":
        hidden = [1]
    model, file = sb3_file(name, net_arch=hidden)
    policy = read("sb3", file)
    expected, _ = model.predict(observations().numpy(), deterministic=True)
    close(policy, torch.from_numpy(expected))


@pytest.mark.parametrize(("activation", "module"), [("elu", torch.nn.ELU), ("silu", torch.nn.SiLU)])
def test_sb3_activation_option(activation, module):
    model, file = sb3_file(net_arch=[16], activation_fn=module)
    expected, _ = model.predict(observations().numpy(), deterministic=True)
    close(read("sb3", file, activation=activation), torch.from_numpy(expected))
    assert float((read("sb3", file)(observations()) - torch.from_numpy(expected)).abs().max()) > 1e-3


def test_sb3_standard_deviation_is_imported():
    model, file = sb3_file()
    assert torch.equal(read("sb3", file).log_std, model.policy.log_std.detach())


def test_vec_normalize_is_imported_from_safetensors(capfd):
    model, file = sb3_file(net_arch=[16])
    venv = VecNormalize(DummyVecEnv([Still]))
    for _ in range(5):
        venv.obs_rms.update(np.random.default_rng(0).normal(3.0, 2.0, (100, OBSERVATIONS)))
    venv.save("vecnormalize.pkl")
    output = refused_by_command(capfd, "sb3", file, "--normalizer", "vecnormalize.pkl")
    assert "is a pickle" in output
    assert "safetensors.numpy.save_file" in output
    assert "is a pickle" in refused_by_command(capfd, "sb3", "vecnormalize.pkl")
    safetensors.numpy.save_file({"mean": venv.obs_rms.mean, "var": venv.obs_rms.var}, "normalizer.safetensors")
    policy = imported("sb3", file, "--normalizer", "normalizer.safetensors")
    seen = venv.normalize_obs(observations().numpy() + 3.0)
    expected, _ = model.predict(seen, deterministic=True)
    close(policy, torch.from_numpy(expected), observations() + 3.0)


def runner_of(**actor):
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=4"]), seed=3)
    settings = {
        "num_steps_per_env": 8,
        "save_interval": 50,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {
            "class_name": "MLPModel",
            "hidden_dims": [32, 16],
            "activation": "elu",
            "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.7},
            **actor,
        },
        "critic": {"class_name": "MLPModel", "hidden_dims": [8]},
        "algorithm": {"class_name": "PPO"},
    }
    return OnPolicyRunner(RslRlVecEnv(env), settings, device="cpu")


@pytest.mark.parametrize(
    ("normalized", "std"), chosen([(True, "scalar"), (False, "log"), (True, "log"), (False, "scalar")], 2)
)
def test_rsl_rl_policy_gives_the_same_actions(normalized, std, capfd):
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.7, "std_type": std}
    runner = runner_of(obs_normalization=normalized, distribution_cfg=distribution)
    runner.learn(2)
    runner.save("model_2.pt")
    policy = imported("rsl-rl", "model_2.pt") if normalized else read("rsl-rl", "model_2.pt")
    act = runner.get_inference_policy()
    with torch.no_grad():
        close(policy, act(TensorDict({"policy": observations()}, batch_size=[ROWS])))
        assert torch.allclose(
            policy.log_std.exp(),
            act.distribution.std_param if std == "scalar" else act.distribution.log_std_param.exp(),
        )


def test_rsl_rl_recurrent_policy_gives_the_same_actions(capfd):
    runner = runner_of(class_name="RNNModel", rnn_type="lstm", rnn_hidden_dim=6, rnn_num_layers=2)
    runner.save("model_0.pt")
    policy = read("rsl-rl", "model_0.pt")
    act, memory = runner.get_inference_policy(), None
    act.reset()
    with torch.no_grad():
        for step in range(20):
            obs = torch.randn(50, OBSERVATIONS, generator=torch.Generator().manual_seed(step))
            expected = act(TensorDict({"policy": obs}, batch_size=[50]))
            found, memory = policy.step(obs, memory)
            assert float((found - expected).abs().max()) <= 1e-6


@pytest.mark.parametrize("normalizer", [None, "2", "3"])
def test_older_rsl_rl_checkpoints_are_read(normalizer):
    act = old_rsl_rl_checkpoint(normalizer)
    policy = read("rsl-rl", "model_7.pt")
    with torch.no_grad():
        close(policy, act(observations()))
    assert torch.allclose(policy.log_std.exp(), torch.tensor([0.3]))


@pytest.mark.slow
def test_imported_policy_can_be_evaluated_exported_and_resumed(capfd):
    _, file = sb3_file(net_arch=[32, 32], activation_fn=torch.nn.ELU)
    policy = imported("sb3", file, "--activation", "elu", "--agent", "sb3-ppo")
    (run,) = Path("runs/cartpole").iterdir()
    assert main(["eval", "--checkpoint", str(run), "--episodes", "2", "--num-envs", "2"]) == 0
    assert main(["export", "--checkpoint", str(run), "--format", "onnx", "--output", "policy.onnx"]) == 0
    words = ["scene.num_envs=8", "--logger", "none", "--max-iterations", "1", "--runs-dir", "trained", "-q"]
    network = "agent.policy={hidden: [32, 32], activation: elu}"
    assert main(["train", "cartpole", "--agent", "sb3-ppo", network, *words, "--init-from", str(run)]) == 0
    (trained,) = Path("trained/cartpole").iterdir()
    begun = open_checkpoint(trained / "checkpoints" / "000000000000").policy()
    assert all(torch.equal(value, policy.state_dict()[name]) for name, value in begun.state_dict().items())
    capfd.readouterr()
    assert main(["train", "--resume", str(run), "--max-iterations", "2"]) == 5
    assert "--init-from" in capfd.readouterr().err


@pytest.mark.parametrize(("form", "size"), [("sb3", "action_size"), ("rsl-rl", "observation_size")])
def test_policy_of_another_shape_is_refused_with_a_table(form, size, capfd):
    if form == "sb3":
        Still.action_space = gym.spaces.Box(-1.0, 1.0, (3,))
        try:
            _, file = sb3_file()
        finally:
            Still.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    else:
        weights = {"actor.0.weight": torch.randn(1, 9), "actor.0.bias": torch.zeros(1), "std": torch.ones(1)}
        torch.save({"model_state_dict": weights}, "model_7.pt")
        file = "model_7.pt"
    output = refused_by_command(capfd, form, file)
    assert f"error:   {size}" in output
    assert "of cartpole" in output


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--activation", "tahn"], "did you mean 'tanh'"),
        (["--action-bound", "-1"], "--action-bound"),
        (["--action-bound", "nan"], "--action-bound"),
    ],
)
def test_invalid_import_option_is_a_usage_error(words, named, capfd):
    assert named in refused_by_command(capfd, "sb3", "model.zip", *words, code=2)
