"""The manager-based workflow: actions, observations, events, rewards and terminations as lists of small terms."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from rlcli.config.terms import SELECTORS
from rlcli.envs.vec_env import Layout, TermLayout, VecEnv
from rlcli.managers.action import ActionManager, CommandMap
from rlcli.managers.event import EventManager
from rlcli.managers.observation import ObservationManager, Watch
from rlcli.managers.reward import RewardManager
from rlcli.managers.term import BoundTerm
from rlcli.managers.termination import TerminationManager
from rlcli.sim.scene import ActuatorNeed, Scene
from rlcli.sim.selection import Selection

_UNIT = re.compile(r"\[([^\]]+)\]")
"""The unit in the first line of a term's docstring."""


class ManagedEnv(VecEnv):
    """A manager-based task. A step: actions, physics, terminations, rewards, resets, events, observations."""

    def _prepare(self, scene: Scene) -> None:
        scene.add_actuators(self._actuator_needs())
        for config in self.config.events.values():
            assert config is not None
            signature = self.resolved.vocabulary.find("events", config.func)
            prepare = None if signature is None else getattr(self._binder.load(signature), "prepare", None)
            if prepare is not None:
                prepare(scene.spec, config.params)

    def _bind(self) -> None:
        binder = self._binder
        self._actions = binder.bind_all("actions")
        self._events = binder.bind_all("events")
        self._terminations = binder.bind_all("terminations")
        self._rewards = binder.bind_all("rewards")
        self._observations = {group: binder.bind_group(group) for group in self.config.observations}

    def _build(self) -> None:
        # in this order: a term's first value may use what stands before it
        n, device = self.num_envs, self.device
        self.action_manager = ActionManager(self._actions, n, device)
        self.termination_manager = TerminationManager(self._terminations, n, device)
        self.event_manager = EventManager(self._events, n, self.step_dt, device, self.engine.set_constants)
        if self.event_manager.derives:
            self.engine.set_constants()  # makes room for them; from here on all of them are derived in one way
        self.event_manager.startup(self._everyone())
        reward_dt = self.step_dt if self.config.reward_dt_scaling else 1.0
        self.reward_manager = RewardManager(self._rewards, n, reward_dt, device, self.config.divergence_reward)
        self.observation_manager = ObservationManager(self._observations, n, device, self._watch())

    def holders(self) -> list[Any]:
        """The terms that are objects."""
        bound = [*self._actions, *self._events, *self._terminations, *self._rewards]
        terms = [*bound, *(term for group in self._observations.values() for term in group)]
        return [term.instance for term in terms if not isinstance(term.instance, functools.partial)]

    def _watch(self) -> Watch | None:
        return self.engine.watch if self.engine.asynchronous else None

    def _layout(self) -> Layout:
        observations = {
            group: tuple(self._observation_layout(term, size) for term, size in self.observation_manager.sizes(group))
            for group in self.config.observations
        }
        actions = tuple(_action_layout(term) for term in self.action_manager.terms)
        return Layout(observations, actions, self.step_dt, self.physics_dt, self.config.decimation)

    def _observation_layout(self, term: BoundTerm, size: int) -> TermLayout:
        signature = self.resolved.vocabulary.find("observations", term.config.func)
        unit = _UNIT.search(signature.summary) if signature is not None else None
        scale = term.config.scale  # type: ignore[attr-defined]
        return TermLayout(
            term.name,
            size,
            tuple(next(iter(term.elements.values()), [])),
            unit[1] if unit else "",
            scale=None if scale is None else tuple(scale) if isinstance(scale, list) else (scale,) * size,
            clip=term.config.clip,  # type: ignore[attr-defined]
        )

    def _act(self, action: Tensor) -> None:
        self.action_manager.process(action)

    def _judge(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        terminated, truncated = self.termination_manager.compute(diverged)
        reward = self.reward_manager.compute()
        if diverged is not None:
            self.reward_manager.replace_diverged(diverged, reward)
        return reward, terminated, truncated

    def _explain(self, what: str) -> None:
        if what == "the reward":
            self.reward_manager.explain()

    def _final(self) -> dict[str, Tensor]:
        return self.observation_manager.compute_final()

    def _terms_of(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        returns, terms = self.reward_manager.episode(ended)
        return returns, terms, self.termination_manager.causes(ended)

    def _start_over(self) -> None:
        self.event_manager.start_over(self._everyone())

    def _restart_workflow(self, selection: Selection) -> None:
        self.event_manager.reset(selection, self._steps)
        self.action_manager.reset(selection)
        self.reward_manager.reset(selection)
        self.termination_manager.reset(selection)
        self.observation_manager.reset(selection)

    def _between(self) -> None:
        if not self.event_manager.has_intervals:
            return
        steps = self._steps.expand(self.num_envs).contiguous()
        running = (self.episode_length_buf > 0).long()  # no time has passed for those just reset
        self.event_manager.interval(lambda mask: self.engine.select(mask, self.seed, steps), running, self._written)

    def _written(self, selection: Selection) -> None:
        self.engine.forward(selection)
        self.sim.refresh_rows(selection)

    def _observe(self) -> dict[str, Tensor]:
        return self.observation_manager.compute()

    def _workflow_state(self) -> dict[str, Tensor]:
        state: dict[str, Tensor] = {}
        for name, part in self._parts().items():
            state.update({f"{name}.{key}": value for key, value in part.state_dict().items()})
        return state

    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        for name, part in self._parts().items():
            prefix = f"{name}."
            part.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})

    def _parts(self) -> dict[str, ActionManager | EventManager | RewardManager]:
        parts: dict = {
            "action": self.action_manager,
            "event": self.event_manager,
            "reward": self.reward_manager,
        }
        terms = [
            *self.action_manager.terms,
            *self.event_manager.terms,
            *self.termination_manager.terms,
            *self.reward_manager.terms,
            *(term for group in self.observation_manager.groups.values() for term in group.terms),
        ]
        return {**parts, **{"term." + ".".join(map(str, t.path)): t for t in terms if t.state_dict()}}

    def _actuator_needs(self) -> list[ActuatorNeed]:
        needs = []
        for name, config in self.config.actions.items():
            assert config is not None
            signature = self.resolved.vocabulary.find("actions", config.func)
            assert signature is not None
            kind = getattr(self._binder.load(signature), "actuator", None)
            joints = next((p.name for p in signature.parameters if p.alias == SELECTORS[0]), None)
            if kind is not None and joints is not None:
                needs.append(
                    ActuatorNeed(config.params["entity"], config.params[joints], kind, ("actions", name, joints))
                )
        return needs


def _action_layout(term: BoundTerm) -> TermLayout:
    action = term.instance
    layout = TermLayout(term.name, action.size, action.elements, action.unit)
    if not hasattr(action, "command_map"):
        return layout
    command: CommandMap = action.command_map()
    return replace(layout, scale=command.scale, clip=command.clip, offset=command.offset, limits=command.limits)
