"""Proximal policy optimisation (Schulman et al. 2017): roll out, estimate advantages, update; then again.

The rollout and the update take nothing, return nothing and never ask the device for a value: all they read and write
are tensors made beforehand, so that on a GPU each of them is captured once and replayed. `iterate` reads one small
tensor of metrics, once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DivergedError
from rlcli.random import derive
from rlcli.rl import distributed
from rlcli.rl.capture import captured
from rlcli.rl.finite import LEARNER_HINT, moments, require_finite
from rlcli.rl.fusion import fused, tensor_cores
from rlcli.rl.networks import ActorCritic, ValueNormalizer, adam, flatten, remembered
from rlcli.rl.optimizers import below
from rlcli.rl.policy import Lstm, Normalizer, Policy
from rlcli.rl.ppo_config import PpoConfig
from rlcli.rl.ppo_gradient import PpoGradient, has_closed_form
from rlcli.rl.ppo_loss import KL, METRICS, Judged, Parts, log_prob
from rlcli.rl.ppo_rollout import Rollout, Samples
from rlcli.rl.ppo_setup import compilation, critic_groups, minibatch_sizes, policy_spec, vision_spec
from rlcli.rl.rng import load_rng_state, rng_state, seed_generators
from rlcli.rl.statistics import EpisodeStatistics
from rlcli.rl.train import Budget
from rlcli.rl.trainer import Report, TrainerState
from rlcli.sim.saved import require_alike
from rlcli.sim.state import is_finite

_RECORDED = 256
"""Recent observations that a checkpoint keeps, for checking what is made of the policy later."""


class PpoTrainer:
    """Learns by PPO, one iteration at a time.

    Args:
        env: the environment.
        config: the agent.
        seed: of the networks and of exploration.
        device: where networks and samples live, as the environment does.
        torch_threads: threads of the update; the rollout runs torch on one, because two thread pools fight.
    """

    def __init__(self, env: VecEnv, config: PpoConfig, *, seed: int, device: str, torch_threads: int) -> None:
        self.env, self.config, self.torch_threads = env, config, torch_threads
        self.device = torch.device(device)
        self.peers = distributed.current()
        self.iteration, self.env_steps = 0, 0
        self._own_steps = config.num_steps * env.num_envs
        self.steps_per_iteration = self._own_steps * self.peers.size
        env.final_obs_of = "truncated"
        self.statistics = EpisodeStatistics(env.config.episode_length_s)
        self._groups = critic_groups(env, config)
        self.spec = policy_spec(env, config)
        obs_size, critic_size = self.spec.observation_size, sum(env.layout.size(group) for group in self._groups)
        shared = self._groups == ("policy",)

        torch.set_num_threads(torch_threads)
        seed_generators(derive(seed, "trainer"))
        eyes = (self.spec.vision, vision_spec(env, config, self._groups))
        self.networks = ActorCritic(obs_size, critic_size, self.spec.action_size, config, *eyes).to(self.device)
        self._vector, self._shared, places = flatten(self.networks)
        self._gradient, self._shared_kl = self._shared[:-1], self._shared[-1]
        self.peers.lead_(self._vector.data)
        end = min(place.start for name, place in places.items() if name.startswith("critic"))
        joint = config.clip_grad == "joint"
        self._gradient_parts = (self._gradient,) if joint else (self._gradient[:end], self._gradient[end:])
        self.learning_rate = torch.tensor(config.learning_rate, device=self.device)
        seed_generators(self.peers.seed(derive(seed, "exploration"), "exploration"))
        self._ceiling = torch.tensor(config.learning_rate_range[1], device=self.device)
        self._optimizer = adam(self._vector, self.learning_rate, config.adam_eps)
        normalize = config.normalize_observations
        self.normalizer = Normalizer(obs_size).to(self.device) if normalize else None
        self.critic_normalizer = Normalizer(critic_size).to(self.device) if normalize and not shared else None
        self.value_normalizer = ValueNormalizer().to(self.device) if config.normalize_value else None

        sizes = (obs_size, 0 if shared else critic_size, self.spec.action_size)
        minibatches = minibatch_sizes(env, config, self._own_steps)
        self._rollout = Rollout(config.num_steps, env.num_envs, sizes, minibatches, config.rnn is not None, self.device)
        self._obs = {g: torch.zeros(env.num_envs, env.layout.size(g), device=self.device) for g in self._read()}
        kept = self._obs if normalize else {}
        self._raw = {g: torch.zeros(config.num_steps, *obs.shape, device=self.device) for g, obs in kept.items()}
        self._begins = torch.ones(env.num_envs, device=self.device)
        # what actor and critic remember now, and what they remembered when the rollout began
        self._memory, self._memory_before = ({k: m.blank(env.num_envs) for k, m in self._memories()} for _ in range(2))
        self._old_std = torch.ones(len(minibatches), self.spec.action_size, device=self.device)
        self._kl = torch.zeros((), device=self.device)
        self._sums = torch.zeros(len(METRICS), device=self.device)
        self._metrics = torch.zeros(len(METRICS) + 4, device=self.device)
        self._recorded = torch.zeros(0, obs_size, device=self.device)
        self._notes: list[str] = []
        self._checks = self.device.type == "cpu"
        """Whether to ask after every stage if all is finite; a GPU, which must not be asked, is once an iteration."""
        self._collect = captured(self._roll_out, self.device, env.holders(), self._notes.append)
        self._tf32, self._parts = config.tf32 and self.device.type == "cuda", Parts()
        how = compilation(config, self.device, self.steps_per_iteration)
        by_hand = not how and has_closed_form(self.networks)
        written = (self.networks, self._shared, places, max(minibatches), torch_threads)
        self._gradient_of = PpoGradient(*written) if by_hand else None
        """On a CPU, for plain networks: a thread takes whole parts of a minibatch; torch has one within a part."""
        if how:
            self._parts = fused(self._parts, self._rehearse, self._notes.append, tuned=how == "tuned")
        self._learn = captured(self._update, self.device, tell=self._notes.append)

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        self._take_in(self.env.reset(seed=self.env.seed))
        self._record()

    def iterate(self) -> Report:
        """Collect experience, then update."""
        physics, step = self.env.seconds["physics"], self.env.seconds["step"]
        begin = time.perf_counter()
        torch.set_num_threads(1)
        try:
            self._collect()
        except DivergedError:
            require_finite(self._learned(), self.iteration + 1)  # where the action comes from, it may have gone wrong
            raise
        self._record()
        collected = self._now()
        torch.set_num_threads(self.torch_threads if self._gradient_of is None else 1)
        self._decay()
        self.iteration += 1
        self.env_steps += self.steps_per_iteration
        self._learn()
        learned = self._now()
        losses = self._losses()
        self.env.check()
        if self.peers.size > 1:
            self.statistics.share(self.peers)
        physics, step = self.env.seconds["physics"] - physics, self.env.seconds["step"] - step
        total = time.perf_counter() - begin
        if isinstance(collected, float):
            rollout = collected - begin
            seconds = {"physics": physics, "task": step - physics, "policy": rollout - step, "update": total - rollout}
        else:  # a replayed rollout cannot be told apart
            update = collected.elapsed_time(learned) / 1e3
            seconds = {"rollout": total - update, "update": update}
        notes, self._notes[:] = list(self._notes), []
        task = {name: value for name, value in self.env.extras().items() if math.isfinite(value)}
        return Report({**self.statistics.flush(), **task, **losses}, seconds, notes)

    def _now(self) -> Any:
        """A moment: on a GPU one in the order of its work, so that nobody has to wait for it."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    # --- the rollout ---

    @torch.no_grad()
    def _roll_out(self) -> None:
        """Take `num_steps` in every environment with the policy as it is."""
        rollout, samples, bound = self._rollout, self._rollout.samples, self.config.action_bound
        for name, memory in self._memory.items():
            self._memory_before[name].copy_(memory)
        std, noise = self.networks.std, torch.randn_like(samples.action)
        deviation = std * noise
        samples.log_prob.copy_(log_prob(noise, std))
        seen, begins = self._obs, self._begins
        for t in range(self.config.num_steps):
            obs, critic_obs = self._see(t, seen)
            mean = self.networks.mean(self._recall(obs, begins))
            action = mean + deviation[t]
            step = self.env.step(action if bound is None else action.clamp(-bound, bound))
            samples.obs[t].copy_(obs)
            if samples.critic_obs is not samples.obs:
                samples.critic_obs[t].copy_(critic_obs)
            samples.action[t].copy_(action)
            samples.mean[t].copy_(mean)
            self._keep_outcome(t, step)
            seen, begins = step.obs, rollout.ended[t]
        self._take_in(seen)
        samples.begins[0].copy_(self._begins)
        samples.begins[1:].copy_(rollout.ended[:-1])
        self._begins.copy_(begins)
        self._old_std.copy_(std.expand_as(self._old_std))

    def _see(self, t: int, obs: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The observations of step t as actor and critic see them."""
        if self.normalizer is not None:
            for group, raw in self._raw.items():
                raw[t].copy_(obs[group])
            if self.config.normalizer_update == "step":
                self._update_normalizers(obs)
        return self._actor_input(obs), self._critic_input(obs)

    def _recall(self, obs: Tensor, begins: Tensor) -> Tensor:
        """What the actor's network sees: the observation, or what the memory makes of it."""
        if self.networks.memory is None:
            return obs
        memory = self._memory["actor"]
        features, after = self.networks.memory(obs, memory * (1.0 - begins)[:, None])
        memory.copy_(after)
        return features

    def _keep_outcome(self, t: int, step: StepResult) -> None:
        rollout = self._rollout
        torch.mul(step.reward, self.config.reward_scale, out=rollout.reward[t])
        torch.logical_or(step.terminated, step.truncated, out=rollout.ended[t])
        torch.gt(step.truncated, step.terminated, out=rollout.cut[t])  # true above false: by time alone
        if step.final_obs is not None and self.config.bootstrap == "final_obs":
            rollout.final_obs[t].copy_(self._critic_input(step.final_obs))
        self.statistics.add(step.episodes)

    # --- the advantages ---

    @torch.no_grad()
    def _estimate_advantages(self) -> None:
        """Generalised advantage estimation (Schulman et al. 2016), backwards over the rollout."""
        config, rollout, samples = self.config, self._rollout, self._rollout.samples
        value, next_value, beyond = self._values() if self.networks.memory is None else self._remembered_values()
        if config.bootstrap == "pre_step":
            beyond = value * rollout.cut
        reward, alive = rollout.reward + config.gamma * beyond, 1.0 - rollout.ended
        delta = reward + config.gamma * torch.cat([value[1:], next_value[None]]) * alive - value
        fading, advantage = config.gamma * config.lam * alive, torch.zeros_like(next_value)
        for t in reversed(range(config.num_steps)):
            advantage = torch.addcmul(delta[t], fading[t], advantage, out=samples.advantage[t])
        samples.value.copy_(value)
        torch.add(samples.advantage, value, out=samples.target)
        if self._checks and not self._rollout.is_finite():
            require_finite(self._learned(), self.iteration)
            require_finite(self._rollout.in_order(), self.iteration, ("step", "environment"))
        self._explain(value)
        if self.value_normalizer is not None:
            for column in (samples.value, samples.target):
                self._learn_moments(self.value_normalizer, column.flatten())
                column.copy_(self.value_normalizer(column))
        if config.normalize_advantage == "batch":
            samples.advantage.copy_(self._standardized(samples.advantage))

    def _values(self) -> tuple[Tensor, Tensor, Tensor]:
        """The values of all observations, of those after the rollout, and of the last ones of episodes cut by time."""
        rollout = self._rollout
        value, next_value = self._value(rollout.samples.critic_obs), self._value(self._critic_input(self._obs))
        return value, next_value, self._value_where(rollout.cut, rollout.final_obs)

    def _remembered_values(self) -> tuple[Tensor, Tensor, Tensor]:
        """The same of a critic with a memory."""
        recall, memory, rollout = self.networks.critic_memory, self._memory["critic"], self._rollout
        assert recall is not None
        seen, states = remembered(recall, rollout.samples.critic_obs, rollout.samples.begins, memory)
        finals = [recall(obs, state)[0] for obs, state in zip(rollout.final_obs, states, strict=True)]
        memory.copy_(states[-1])
        following, _ = recall(self._critic_input(self._obs), memory * (1.0 - self._begins)[:, None])
        beyond = torch.where(rollout.cut, self._value(torch.stack(finals)), 0.0)
        return self._value(seen), self._value(following), beyond

    def _value(self, critic_obs: Tensor) -> Tensor:
        value = self.networks.value(critic_obs)
        return value if self.value_normalizer is None else self.value_normalizer.inverse(value)

    def _value_where(self, mask: Tensor, critic_obs: Tensor) -> Tensor:
        """The value where the mask is set, 0 elsewhere. A GPU, which must not be asked how many, computes all."""
        if self.device.type == "cpu":
            value = torch.zeros(mask.shape)
            value[mask] = self._value(critic_obs[mask])
            return value
        return torch.where(mask, self._value(critic_obs), 0.0)

    def _standardized(self, values: Tensor) -> Tensor:
        deviation = values - self.peers.average_(values.mean())
        count = values.numel() * self.peers.size
        variance = self.peers.average_(deviation.square().mean()) * (count / (count - 1))
        return deviation / (variance.sqrt() + 1e-8)

    def _explain(self, value: Tensor) -> None:
        """The share of the returns' variance that the critic knew beforehand."""
        target = self._rollout.samples.target
        self._metrics[-1].copy_(1.0 - (target - value).var() / target.var())

    # --- the update ---

    def _update(self) -> None:
        """Estimate advantages, then descend."""
        with tensor_cores(self._tf32):
            self._estimate_advantages()
            if self.normalizer is not None and self.config.normalizer_update == "rollout":
                self._update_normalizers(self._raw)
            self._optimize()
            self._conclude()

    def _optimize(self) -> None:
        """Several epochs of minibatches."""
        config, rollout = self.config, self._rollout
        self._sums.zero_()
        for epoch in range(config.num_epochs):
            if epoch == 0 or config.shuffle == "epoch":
                rollout.arrange(self._order())
            self._kl.zero_()
            for number, minibatch in enumerate(rollout.minibatches):
                self._descend(minibatch, number)
            self._adapt(self._kl / len(rollout.minibatches), "epoch")
        self._adapt(self._kl / len(rollout.minibatches), "iteration")

    def _order(self) -> Tensor:
        """The samples in the order of the minibatches."""
        shuffled, rollout = self.config.shuffle != "none", self._rollout
        if self.networks.memory is not None:
            some = torch.randperm if shuffled else torch.arange
            return rollout.group(some(self.env.num_envs, device=self.device))
        return torch.randperm(self._own_steps, device=self.device) if shuffled else rollout.by_environment

    def _descend(self, batch: Samples, number: int) -> None:
        """One step of Adam down the clipped surrogate objective."""
        judged = self._differentiate(self._parts.judge, batch, number)
        self._sums += judged.metrics
        self.peers.average_(self._shared)
        if self._checks and not (is_finite(self._shared) and is_finite(judged.metrics)):
            require_finite(self._stages(judged), self.iteration)
        if self.config.kl_from == "rollout":
            self._adapt(self._shared_kl, "minibatch")
        self._clip_gradient()
        self._optimizer.step()
        if self._checks and not is_finite(self._vector):
            require_finite([("the learning rate", self.learning_rate), *self._weights()], self.iteration)
        if self.config.kl_from == "last_pass":
            self._adapt(self._shared_kl, "minibatch")
            batch.mean.copy_(judged.mean)
            self._old_std[number].copy_(judged.std)
        if self.config.kl_grain != "minibatch":
            self._kl += self._shared_kl

    def _differentiate(self, judge: Callable[..., Judged], batch: Samples, number: int) -> Judged:
        """Judge a minibatch; gradient and divergence are then where all processes can share them."""
        obs, critic_obs = self._inputs(batch, number)
        per_minibatch = self.config.normalize_advantage == "minibatch"
        advantage = self._standardized(batch.advantage) if per_minibatch else batch.advantage
        if self._gradient_of is not None:
            return self._gradient_of(self.config, batch, advantage, self._old_std[number])
        judged = judge(self.networks, self.config, batch, obs, critic_obs, advantage, self._old_std[number])
        gradients = torch.autograd.grad(judged.loss, list(self.networks.parameters()))
        torch.cat([*(part.flatten() for part in gradients), judged.metrics[KL : KL + 1]], out=self._shared)
        return judged

    def _stages(self, judged: Judged) -> list[tuple[str, Tensor]]:
        """What a minibatch gave, in the order in which it came: losses, then gradients from the outputs backwards."""
        losses = [(f"the loss ({name})", judged.metrics[i]) for i, name in enumerate(METRICS) if i != KL]
        names, parameters = zip(*self.networks.named_parameters(), strict=True)
        gradients = self._gradient.split([parameter.numel() for parameter in parameters])
        backwards = [(f"the gradient of '{name}'", gradient) for name, gradient in zip(names, gradients, strict=True)][
            ::-1
        ]
        return [*losses, ("the loss", judged.loss.detach()), *backwards, ("the divergence (KL)", self._shared_kl)]

    def _weights(self) -> list[tuple[str, Tensor]]:
        return [(f"weight '{name}'", parameter.detach()) for name, parameter in self.networks.named_parameters()]

    def _learned(self) -> list[tuple[str, Tensor]]:
        """What a rollout is made with."""
        memories = [(f"the memory of the {name}", memory) for name, memory in self._memory_before.items()]
        return [*self._moments(), *self._weights(), *memories]

    def _moments(self) -> list[tuple[str, Tensor]]:
        return moments(
            [
                ("observation", self.normalizer),
                ("critic's observation", self.critic_normalizer),
                ("value", self.value_normalizer),
            ]
        )

    def _inputs(self, batch: Samples, number: int) -> tuple[Tensor, Tensor]:
        """What the networks see of a minibatch: with memories, they go through its environments' steps again."""
        if self.networks.memory is None:
            return batch.obs, batch.critic_obs
        environments, seen = self._rollout.environments[number], {"actor": batch.obs, "critic": batch.critic_obs}
        steps = (self.config.num_steps, len(environments))
        features = [
            remembered(
                memory,
                seen[name].unflatten(0, steps),
                batch.begins.unflatten(0, steps),
                self._memory_before[name].index_select(0, environments),
            )[0].flatten(0, 1)
            for name, memory in self._memories()
        ]
        return features[0], features[1]

    def _adapt(self, kl: Tensor, grain: str) -> None:
        """Adapt the learning rate, if that is the grain to do it at."""
        if self.config.desired_kl is not None and grain == self.config.kl_grain:
            self._parts.adapt_(self.learning_rate, self._ceiling, kl, self.config)

    def _rehearse(self, parts: Parts) -> None:
        """Call what an update is made of on every shape of a minibatch; nothing that counts is changed."""
        with tensor_cores(self._tf32):
            for number, minibatch in {len(b.target): (i, b) for i, b in enumerate(self._rollout.minibatches)}.values():
                self._differentiate(parts.judge, minibatch, number)
            if self.config.max_grad_norm is not None:
                parts.clip_(self._gradient_parts, self.config.max_grad_norm)
            if self.config.desired_kl is not None:
                parts.adapt_(self.learning_rate.clone(), self._ceiling, self._shared_kl, self.config)

    def _clip_gradient(self) -> None:
        if self.config.max_grad_norm is not None:
            self._parts.clip_(self._gradient_parts, self.config.max_grad_norm)

    @torch.no_grad()
    def _conclude(self) -> None:
        """Put together what `iterate` reads."""
        updates = self.config.num_epochs * len(self._rollout.minibatches)
        sums = torch.stack([values.sum().double() for _, values in (("", self._vector), *self._moments())])
        last = torch.stack((self.networks.std.mean(), self.learning_rate, sums.isfinite().all().float()))
        self._metrics[: len(METRICS)].copy_(self._sums / updates)
        self._metrics[len(METRICS) : -1].copy_(last)
        self.peers.average_(self._metrics)

    # --- between rollout and update ---

    def _losses(self) -> dict[str, float]:
        *losses, std, learning_rate, finite, explained = self._metrics.tolist()
        metrics = {f"Loss/{name}": value for name, value in zip(METRICS, losses, strict=True)}
        metrics |= {"Policy/mean_std": std, "Loss/learning_rate": learning_rate, "Loss/explained_variance": explained}
        wrong = [n for n in ("Loss/surrogate", "Loss/value", "Policy/mean_std") if not math.isfinite(metrics[n])]
        if wrong or finite < 1.0:
            if not self._rollout.is_finite():
                require_finite(self._rollout.in_order(), self.iteration, ("step", "environment"))
            require_finite(self._moments(), self.iteration)
            if wrong:
                raise DivergedError(f"{wrong[0]} is not finite in iteration {self.iteration}", hint=LEARNER_HINT)
            require_finite(self._weights(), self.iteration)
        if not self.config.bounds_coef:
            del metrics["Loss/bounds"]
        return {name: value for name, value in metrics.items() if math.isfinite(value)}

    def _decay(self) -> None:
        config = self.config
        if not config.schedule.endswith("linear"):
            return
        left = max(0.0, 1.0 - Budget(config.max_iterations, config.max_steps).share(self))
        if config.schedule == "linear":
            self.learning_rate.fill_(config.learning_rate * left)
        else:
            self._ceiling.fill_(config.learning_rate_range[1] * left)
            self.learning_rate.clamp_(max=self._ceiling)

    def _record(self) -> None:
        self._recorded = torch.cat([self._obs["policy"][:_RECORDED], self._recorded])[:_RECORDED]

    def _memories(self) -> list[tuple[str, Lstm]]:
        pairs = (("actor", self.networks.memory), ("critic", self.networks.critic_memory))
        return [(name, memory) for name, memory in pairs if memory is not None]

    # --- observations ---

    def _read(self) -> tuple[str, ...]:
        """The groups that are read."""
        return tuple(dict.fromkeys(("policy", *self._groups)))

    def _take_in(self, obs: Mapping[str, Tensor]) -> None:
        for group, own in self._obs.items():
            own.copy_(obs[group])

    def _actor_input(self, obs: Mapping[str, Tensor]) -> Tensor:
        return obs["policy"] if self.normalizer is None else self.normalizer(obs["policy"])

    def _critic_input(self, obs: Mapping[str, Tensor]) -> Tensor:
        if self._groups == ("policy",):
            return self._actor_input(obs)
        joined = _joined(obs, self._groups)
        return joined if self.critic_normalizer is None else self.critic_normalizer(joined)

    def _update_normalizers(self, obs: Mapping[str, Tensor]) -> None:
        if self.normalizer is not None:
            self._learn_moments(self.normalizer, obs["policy"].flatten(0, -2))
        if self.critic_normalizer is not None:
            self._learn_moments(self.critic_normalizer, _joined(obs, self._groups).flatten(0, -2))

    def _learn_moments(self, normalizer: Normalizer, values: Tensor) -> None:
        """Take in a batch of every process. (n, ...)"""
        batch = values.double()
        mean, var = batch.mean(dim=0), batch.var(dim=0, unbiased=False)
        if self.peers.size > 1:
            mean, square = self.peers.average_(torch.stack((mean, var + mean.square())))
            var = square - mean.square()
        normalizer.merge(mean, var, float(len(batch) * self.peers.size))

    # --- saving and restoring ---

    def policy(self) -> Policy:
        """The deployable policy as it is now, with weights of its own."""
        policy = Policy(self.spec)
        policy.load_state_dict(self._policy_tensors())
        return policy.eval().requires_grad_(False)

    def state(self) -> TrainerState:
        """A copy of everything that the next iteration depends on."""
        tensors = {
            "policy": self._policy_tensors(),
            "trainer": {name: _copy(value) for name, value in self._learner().items()},
        }
        tensors["trainer"]["observations"] = _copy(self._recorded)
        values = {
            "policy": self.spec.model_dump(),
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "processes": self.peers.size,
        }
        for rank, (env, rng, statistics) in enumerate(self.peers.gather(self._own_state())):
            suffix = f".{rank}" if rank else ""
            tensors[f"env{suffix}"], tensors[f"rng{suffix}"] = env, rng
            values[f"statistics{suffix}"] = statistics
        return TrainerState(tensors, values)

    def _own_state(self) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
        """What each process has for itself: environments, generators, statistics."""
        rng = rng_state()
        if self.device.type == "cuda":
            rng["cuda"] = torch.cuda.get_rng_state(self.device)
        env = {name: value.cpu() for name, value in self.env.state_dict().items()}
        env["begins"] = _copy(self._begins)
        env |= {f"memory.{name}": _copy(value) for name, value in self._memory.items()}
        return env, rng, self.statistics.state()

    def load(self, state: TrainerState) -> None:
        """Go back to a boundary: on a CPU the next iteration gives the same bits as it did then.

        With another number of processes than then, everything that is learned goes on, in new episodes.
        """
        values, saved = state.values, state.tensors["trainer"]
        require_alike(saved, self._learner(), "trainer")
        self.load_weights(state.tensors["policy"])
        with torch.no_grad():
            for name, value in self._learner().items():
                value.copy_(saved[name])
        self._recorded = saved["observations"].to(self.device)
        self.iteration, self.env_steps = values["iteration"], values["env_steps"]
        if values["processes"] != self.peers.size:
            self._begins.fill_(1.0)
            self.statistics.load(values["statistics"])
            torch.manual_seed(derive(torch.initial_seed(), f"after {self.env_steps} steps"))
            self._take_in(self.env.reset(seed=derive(self.env.seed, f"after {self.env_steps} steps")))
            return
        suffix = f".{self.peers.rank}" if self.peers.rank else ""
        self.statistics.load(values[f"statistics{suffix}"])
        env = state.tensors[f"env{suffix}"]
        carried = {f"memory.{name}": value for name, value in self._memory.items()}
        require_alike(env, {"begins": self._begins, **carried}, "env")
        self._begins.copy_(env["begins"])
        for name, memory in self._memory.items():
            memory.copy_(env[f"memory.{name}"])
        self._take_in(self.env.load_state_dict(env))
        rng = state.tensors[f"rng{suffix}"]
        load_rng_state(rng)
        if self.device.type == "cuda" and "cuda" in rng:
            torch.cuda.set_rng_state(rng["cuda"], self.device)

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Take a policy's weights, with its normaliser; the critic stays as it is."""
        self.networks.load_policy_tensors(policy)
        if self.normalizer is not None:
            self.normalizer.load_state_dict(below(policy, "normalizer."))

    def _policy_tensors(self) -> dict[str, Tensor]:
        tensors = {name: _copy(value) for name, value in self.networks.policy_tensors().items()}
        if self.normalizer is not None:
            tensors.update({f"normalizer.{name}": _copy(v) for name, v in self.normalizer.state_dict().items()})
        return tensors

    def _learner(self) -> dict[str, Tensor]:
        """Everything but the policy that learning goes on from, as it stands."""
        tensors = {
            name: value
            for name, value in self.networks.named_parameters()
            if not name.startswith(("actor.", "memory.", "vision."))
        }
        for name, module in (
            ("critic_normalizer", self.critic_normalizer),
            ("value_normalizer", self.value_normalizer),
        ):
            if module is not None:
                tensors.update({f"{name}.{key}": value for key, value in module.state_dict().items()})
        moments = {f"optimizer.{slot}": value for slot, value in self._optimizer.state[self._vector].items()}
        return {**tensors, **moments, "learning_rate": self.learning_rate}


def _joined(obs: Mapping[str, Tensor], groups: tuple[str, ...]) -> Tensor:
    return obs[groups[0]] if len(groups) == 1 else torch.cat([obs[group] for group in groups], dim=-1)


def _copy(value: Tensor) -> Tensor:
    return value.detach().to("cpu", copy=True)
