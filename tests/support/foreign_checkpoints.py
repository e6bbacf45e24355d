"""Files of Stable-Baselines3 and RSL-RL with policies, and the reading of them."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from rsl_rl.modules import EmpiricalNormalization
from stable_baselines3 import A2C, PPO, SAC, TD3

from rlcli.cli.app import main
from rlcli.errors import CheckpointError
from rlcli.rl.policy import load_policy
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.training.import_policy import read_rsl_rl, read_sb3

ALGORITHMS = {"ppo": PPO, "a2c": A2C, "sac": SAC, "td3": TD3}
OBSERVATIONS = 4
ROWS = 1000


class Still(gym.Env):
    """Environment with cartpole's spaces and without dynamics."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (OBSERVATIONS,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(OBSERVATIONS, dtype=np.float32), {}

    def step(self, action):
        return np.zeros(OBSERVATIONS, dtype=np.float32), 0.0, False, False, {}


def randomized(module):
    """Randomise all weights, as after a training: no bias is 0."""
    with torch.no_grad():
        for value in module.parameters():
            value.add_(0.2 * torch.randn_like(value))
    return module


def sb3_file(name="ppo", **policy):
    model = ALGORITHMS[name]("MlpPolicy", Still(), device="cpu", policy_kwargs=policy, seed=0)
    randomized(model.policy)
    model.save("model.zip")
    return model, Path("model.zip")


def observations():
    return torch.randn(ROWS, OBSERVATIONS, generator=torch.Generator().manual_seed(1)) * 2.0


def imported(form, file, *words):
    """Import through the command line, and return the new run's policy."""
    assert main(["import", form, str(file), "--task", "cartpole", "--runs-dir", "runs", *words]) == 0
    (run,) = Path("runs/cartpole").iterdir()
    return open_checkpoint(run / "checkpoints" / "000000000000").policy()


def read(form, file, **settings):
    """Return the policy of a file."""
    foreign = (read_sb3 if form == "sb3" else read_rsl_rl)(Path(file), **settings)
    return load_policy(foreign.spec, foreign.weights)


def refused_by_command(capfd, *words, code=5):
    """Return the text of the only error, after a check that no run is left."""
    capfd.readouterr()
    assert main(["import", *map(str, words), "--task", "cartpole", "--runs-dir", "runs"]) == code
    out, err = capfd.readouterr()
    assert out == ""
    assert "Traceback" not in err
    errors = [line for line in err.splitlines() if line.startswith("error:") and not line.startswith("error:   ")]
    assert len(errors) == 1, err
    assert not list(Path("runs").glob("*/*/run.json"))
    return err


def refused(form, file):
    """Return the error for a file."""
    with pytest.raises(CheckpointError) as caught:
        (read_sb3 if form == "sb3" else read_rsl_rl)(Path(file))
    assert Path(file).name in caught.value.message
    assert len(caught.value.message) < 1000
    return caught.value.message


def close(policy, expected, obs=None):
    found = policy(observations() if obs is None else obs)
    assert found.shape == expected.shape
    assert float((found - expected).abs().max()) <= 1e-6


def old_rsl_rl_checkpoint(normalizer, **more):
    """Return a checkpoint in the format of RSL-RL 2 and 3, and its network."""
    network = randomized(
        torch.nn.Sequential(
            torch.nn.Linear(OBSERVATIONS, 16),
            torch.nn.ELU(),
            torch.nn.Linear(16, 8),
            torch.nn.ELU(),
            torch.nn.Linear(8, 1),
        )
    )
    stats = EmpiricalNormalization(OBSERVATIONS)
    for _ in range(3):
        stats.update(observations() * 3.0 + 1.0)
    weights = {f"actor.{name}": value for name, value in network.state_dict().items()}
    weights |= {
        "critic.0.weight": torch.randn(1, OBSERVATIONS),
        "critic.0.bias": torch.zeros(1),
        "std": torch.tensor([0.3]),
    }
    saved = {
        "model_state_dict": weights,
        "optimizer_state_dict": {"state": {}, "param_groups": []},
        "iter": 7,
        "infos": None,
    }
    if normalizer == "2":
        saved |= {"obs_norm_state_dict": stats.state_dict(), "privileged_obs_norm_state_dict": stats.state_dict()}
    elif normalizer == "3":
        weights |= {f"actor_obs_normalizer.{name}": value for name, value in stats.state_dict().items()}
    torch.save({**saved, **more}, "model_7.pt")
    stats.eval()
    return lambda obs: network(obs if normalizer is None else stats(obs))
