"""skrl's PPO on an environment of rlcli: the wrapper and the models that skrl requires."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import Wrapper
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

from rlcli.envs.vec_env import VecEnv


class Wrapped(Wrapper):
    """Policy group of a `VecEnv` without copies to the host. A second reset returns the running episodes."""

    def __init__(self, env: VecEnv) -> None:
        super().__init__(env)
        sizes = env.layout.size("policy"), env.layout.action_size
        self._spaces = [gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32) for size in sizes]
        self._seen: torch.Tensor | None = None

    observation_space = property(lambda self: self._spaces[0])
    action_space = property(lambda self: self._spaces[1])
    state_space = property(lambda self: None)

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Return the observations. (num_envs, d)"""
        if self._seen is None:
            self._seen = self._env.reset(seed=0)["policy"]
        return self._seen, {}

    def step(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, Any]:
        """Step; return rewards and flags as columns."""
        result = self._env.step(actions)
        self._seen = result.obs["policy"]
        columns = (values.view(-1, 1) for values in (result.reward, result.terminated, result.truncated))
        return self._seen, *columns, {}

    def state(self) -> None:
        """Return None: there is no state."""

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


def layers(inputs: int, outputs: int) -> torch.nn.Sequential:
    """Return layers of 32-32 ELU."""
    elu, linear = torch.nn.ELU, torch.nn.Linear
    return torch.nn.Sequential(linear(inputs, 32), elu(), linear(32, 32), elu(), linear(32, outputs))


class Actor(GaussianMixin, Model):
    """Gaussian policy with a learned standard deviation that does not depend on the observation."""

    def __init__(self, observations: Any, actions: Any) -> None:
        Model.__init__(self, observation_space=observations, action_space=actions, device="cpu")
        GaussianMixin.__init__(self)
        self.net = layers(self.num_observations, self.num_actions)
        self.log_std_parameter = torch.nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """Compute the mean of the action from the observations."""
        return self.net(inputs["observations"]), {"log_std": self.log_std_parameter}


class Critic(DeterministicMixin, Model):
    """Value function."""

    def __init__(self, observations: Any, actions: Any) -> None:
        Model.__init__(self, observation_space=observations, action_space=actions, device="cpu")
        DeterministicMixin.__init__(self)
        self.net = layers(self.num_observations, 1)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """Compute the value from the observations."""
        return self.net(inputs["observations"]), {}


def trainer(env: VecEnv, steps: int, epochs: int, minibatches: int) -> Callable[[], None]:
    """Return a trainer that writes nothing to disk."""
    wrapped = Wrapped(env)
    spaces = wrapped.observation_space, wrapped.action_space
    settings = PPO_CFG(
        rollouts=steps,
        learning_epochs=epochs,
        mini_batches=minibatches,
        learning_rate=1e-3,
        grad_norm_clip=1.0,
        entropy_loss_scale=0.005,
        value_loss_scale=1.0,
    )
    settings.experiment.write_interval = 0
    settings.experiment.checkpoint_interval = 0
    agent = PPO(
        models={"policy": Actor(*spaces), "value": Critic(*spaces)},
        memory=RandomMemory(memory_size=steps, num_envs=env.num_envs, device="cpu"),
        observation_space=spaces[0],
        action_space=spaces[1],
        device="cpu",
        cfg=settings,
    )
    made = SequentialTrainer(
        env=wrapped, agents=agent, cfg={"timesteps": steps, "headless": True, "disable_progressbar": True}
    )
    return made.train


__all__ = ["trainer"]
