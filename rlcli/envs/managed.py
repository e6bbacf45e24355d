"""The manager-based workflow: every concern of the MDP is a list of small terms, run by a manager."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rlcli.config.schema import ObservationConfig
from rlcli.config.terms import SELECTORS
from rlcli.envs.layout import Layout, TermLayout
from rlcli.envs.markers import Marker
from rlcli.envs.vec_env import VecEnv
from rlcli.managers.action import ActionManager, CommandMap
from rlcli.managers.command import CommandManager
from rlcli.managers.curriculum import CurriculumManager
from rlcli.managers.event import EventManager
from rlcli.managers.observation import ObservationManager, Watch
from rlcli.managers.pipeline import Pipeline
from rlcli.managers.reward import RewardManager
from rlcli.managers.term import BoundTerm
from rlcli.managers.termination import TerminationManager
from rlcli.sim.engine import add_body_forces
from rlcli.sim.saved import require_alike
from rlcli.sim.scene import Scene
from rlcli.sim.scene_joints import ActuatorNeed
from rlcli.sim.selection import Selection

_STATELESS = ("functools", "rlcli.mdp.")
"""Modules of terms that begin alike in every episode."""
_UNIT = re.compile(r"\[([^\]]+)\]")
"""The unit in the first line of a term's docstring."""


class ManagedEnv(VecEnv):
    """A manager-based task.

    A step: actions, physics, terminations, rewards, curriculum and resets, commands, interval events, observations.
    """

    def _prepare(self, scene: Scene) -> None:
        scene.add_actuators(self._actuator_needs())
        if any(getattr(term, "reads_body_forces", False) for term in self._judging_terms()):
            add_body_forces(scene.spec)
        for config in self.config.events.values():
            assert config is not None
            signature = self.resolved.vocabulary.find("events", config.func)
            prepare = None if signature is None else getattr(self._binder.load(signature), "prepare", None)
            if prepare is not None:
                prepare(scene.spec, config.params)

    def _bind(self) -> None:
        binder = self._binder
        self._commands = binder.bind_all("commands")  # first: terms of other sections refer to them
        self._actions = binder.bind_all("actions")
        self._events = binder.bind_all("events")
        self._terminations = binder.bind_all("terminations")
        self._rewards = binder.bind_all("rewards")
        self._observations = {group: binder.bind_group(group) for group in self.config.observations}
        self._curriculum = binder.bind_all("curriculum")

    def _build(self) -> None:
        # in this order: a term's first value may use what stands before it
        self._everywhere = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        n, device, live = self.num_envs, self.device, self._binder.live
        self.command_manager = CommandManager(self._commands, n, self.step_dt, device, live)
        self.action_manager = ActionManager(self._actions, n, device, self.engine.as_field)
        self.termination_manager = TerminationManager(self._terminations, n, device)
        self.event_manager = EventManager(self._events, n, self.step_dt, device, self.engine.set_constants)
        if self.event_manager.derives:
            self.engine.set_constants()  # makes room for them; from here on all of them are derived in one way
        self.event_manager.startup(self._everyone())
        reward_dt = self.step_dt if self.config.reward_dt_scaling else 1.0
        self.reward_manager = RewardManager(
            self._rewards, n, reward_dt, device, live, self.engine.as_field, self.config.divergence_reward
        )
        self.observation_manager = ObservationManager(
            self._observations,
            self.config.observations,
            n,
            self.step_dt,
            device,
            self._everyone_now,
            live,
            self._watch(),
        )
        self.curriculum_manager = CurriculumManager(self._curriculum, live, device)

    def holders(self) -> list[Any]:
        """The terms that are objects."""
        bound = [*self._commands, *self._actions, *self._events, *self._terminations, *self._rewards]
        bound += self._curriculum
        terms = [*bound, *(term for group in self._observations.values() for term in group)]
        return [term.instance for term in terms if not isinstance(term.instance, functools.partial)]

    def carried(self) -> list[str]:
        """Whatever draws by the clock of all episodes, remembers beyond a reset, or may: objects of a task's own."""
        found = [*super().carried(), *(f"actuators.{name}" for name in self._actuators)]
        found += [".".join(map(str, term.path)) for term in (*self._commands, *self._curriculum)]
        for term in self._events:
            config = term.config
            throttled = config.mode == "reset" and config.min_steps_between  # type: ignore[attr-defined]
            if config.mode == "interval" or throttled or hasattr(term.instance, "update"):  # type: ignore[attr-defined]
                found.append(f"events.{term.name}")
        for group, terms in self._observations.items():
            for term in terms:
                config = term.config
                assert isinstance(config, ObservationConfig)
                drawn = config.noise is not None or config.bias is not None or config.delay is not None
                if (drawn and self.config.observations[group].enable_corruption) or config.modifiers:
                    found.append(f"observations.{group}.{term.name}")
        own = [term for term in self._parts().values() if isinstance(term, BoundTerm)]
        found += [".".join(map(str, t.path)) for t in own if not type(t.instance).__module__.startswith(_STATELESS)]
        return list(dict.fromkeys(found))

    def _watch(self) -> Watch | None:
        return self.engine.watch if self.engine.asynchronous else None

    def _layout(self) -> Layout:
        observations = {
            group: tuple(self._observation_layout(pipeline) for pipeline in self.observation_manager.pipelines(group))
            for group in self.config.observations
        }
        actions = tuple(_action_layout(term) for term in self.action_manager.terms)
        return Layout(observations, actions, self.step_dt, self.physics_dt, self.config.decimation)

    def _observation_layout(self, pipeline: Pipeline) -> TermLayout:
        term, config = pipeline.term, pipeline.term.config
        assert isinstance(config, ObservationConfig)
        signature = self.resolved.vocabulary.find("observations", config.func)
        unit = _UNIT.search(signature.summary) if signature is not None else None
        scale = config.scale
        return TermLayout(
            term.name,
            pipeline.size,
            tuple(next(iter(term.elements.values()), [])),
            unit[1] if unit else "",
            scale=None
            if scale is None
            else (tuple(scale) if isinstance(scale, list) else (scale,) * pipeline.width) * pipeline.history,
            clip=config.clip,
            history=pipeline.history,
            shape=pipeline.shape if len(pipeline.shape) > 1 else (),
            modifiers=tuple(modifier.model_dump(mode="json") for modifier in config.modifiers),
        )

    def _act(self, action: Tensor) -> None:
        self.action_manager.process(action)

    def _judge(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        terminated, truncated = self.termination_manager.compute(diverged)
        reward = self.reward_manager.compute(diverged, terminated)
        self._require_finite(reward, "the reward")
        self.reward_manager.add_up()
        if diverged is not None:
            self.reward_manager.replace_diverged(diverged, reward)
        self.command_manager.measure()
        return reward, terminated, truncated

    def _explain(self, what: str) -> None:
        if what == "the reward":
            self.reward_manager.explain()

    def _final(self) -> dict[str, Tensor]:
        return self.observation_manager.compute_final()

    def _terms_of(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        returns, terms = self.reward_manager.episode(ended)
        return returns, terms, self.termination_manager.causes(ended)

    @property
    def reward_names(self) -> list[str]:
        """The terms of the reward."""
        return [term.name for term in self.reward_manager.terms]

    def _paid(self) -> Tensor:
        return self.reward_manager.paid

    def _start_over(self) -> None:
        self.curriculum_manager.advance(self._steps)  # the clock may have been set back
        self.event_manager.start_over(self._everyone())

    def _metrics_of(self, ended: Selection) -> dict[str, Tensor]:
        return self.command_manager.episode(ended)

    def _conclude(self, ended: Selection) -> None:
        self.curriculum_manager.compute(ended)

    def _restart_workflow(self, selection: Selection) -> None:
        self.event_manager.reset(selection, self._steps)
        self.action_manager.reset(selection)
        self.command_manager.reset(selection)
        self.reward_manager.reset(selection)
        self.termination_manager.reset(selection)
        self.observation_manager.reset(selection)

    def _between(self) -> None:
        self.curriculum_manager.advance(self._steps)
        if not self.event_manager.has_intervals and not self.command_manager.terms:
            return
        running = (self.episode_length_buf > 0).long()  # no time has passed for those just reset
        self.command_manager.compute(self._now, running)
        self.event_manager.interval(self._now, running, self._written)

    def _everyone_now(self) -> Selection:
        everyone = self._now(self._everywhere)
        assert everyone is not None
        return everyone

    def _now(self, mask: Tensor) -> Selection | None:
        """A selection that draws from the step's own counter."""
        return self.engine.select(mask, self.seed, self._steps.expand(self.num_envs).contiguous())

    def _written(self, selection: Selection) -> None:
        self.sim.moved(selection)
        for sensor in self.sensors.values():
            sensor.moved(selection)

    def _observe(self) -> dict[str, Tensor]:
        return self.observation_manager.compute()

    def _observe_again(self) -> dict[str, Tensor]:
        return self.observation_manager.again()

    def _extras(self) -> dict[str, float]:
        """What the curriculum's terms gave last."""
        return self.curriculum_manager.values()

    def _workflow_state(self) -> dict[str, Tensor]:
        state: dict[str, Tensor] = {}
        for name, part in self._parts().items():
            state.update({f"{name}.{key}": value for key, value in part.state_dict().items()})
        return state

    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        for name, part in self._parts().items():
            prefix = f"{name}."
            saved = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            if not (isinstance(part, BoundTerm) and part.memory):  # an author's own tensors may come and go
                require_alike(saved, part.state_dict(), f"env: workflow.{name}")
            part.load_state_dict(saved)

    def _parts(self) -> dict[str, Any]:
        parts: dict[str, Any] = {
            "command": self.command_manager,
            "observation": self.observation_manager,
            "curriculum": self.curriculum_manager,
            "action": self.action_manager,
            "event": self.event_manager,
            "reward": self.reward_manager,
        }
        terms = [
            *self.action_manager.terms,
            *self.event_manager.terms,
            *self.termination_manager.terms,
            *self.reward_manager.terms,
            *self.command_manager.terms,
            *self.curriculum_manager.terms,
            *(
                pipeline.term
                for group in self.config.observations
                for pipeline in self.observation_manager.pipelines(group)
            ),
        ]
        return {**parts, **{"term." + ".".join(map(str, t.path)): t for t in terms}}

    def markers(self) -> list[Marker]:
        """What the commands ask for."""
        return self.command_manager.markers()

    def unsaved(self) -> list[str]:
        """What class terms keep that cannot be saved."""
        memories = [part.memory for part in self._parts().values() if isinstance(part, BoundTerm) and part.memory]
        return [what for memory in memories for what in memory.unsaved()]

    def _judging_terms(self) -> Iterator[Any]:
        """The functions and classes behind observations, rewards, terminations and success, before they are bound."""
        task = self.config
        sections = {"rewards": task.rewards, "terminations": task.terminations, "success": {"success": task.success}}
        groups = [("observations", group.terms) for group in task.observations.values()]
        for section, configs in [*sections.items(), *groups]:
            for config in configs.values():  # type: ignore[attr-defined]
                if config is not None:
                    signature = self.resolved.vocabulary.find(section, config.func)
                    assert signature is not None  # phase 1 has looked it up
                    yield self._binder.load(signature)

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
