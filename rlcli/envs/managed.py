"""Manager-based workflow: a task consists of lists of terms (small functions), and each list has a manager.

`ManagedEnv` is the environment that calls the managers.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from rlcli.config.schema import ObservationConfig
from rlcli.config.term_signatures import SELECTORS
from rlcli.envs.layout import Layout, TermLayout
from rlcli.envs.vec_env import VecEnv
from rlcli.managers.action import ActionManager, CommandMap
from rlcli.managers.command import CommandManager
from rlcli.managers.curriculum import CurriculumManager
from rlcli.managers.event import EventManager
from rlcli.managers.observation import ObservationManager
from rlcli.managers.observation_pipeline import Pipeline
from rlcli.managers.reward import RewardManager
from rlcli.managers.term_binding import BoundTerm, EnvContext
from rlcli.managers.termination import TerminationManager
from rlcli.scene.joint_and_actuator_setup import ActuatorNeed
from rlcli.scene.scene import Scene
from rlcli.sim.acceleration_fields import add_body_forces
from rlcli.sim.env_selection import Field, Selection
from rlcli.sim.markers import Marker
from rlcli.sim.saved_tensors import require_matching_tensors, substate

_STATELESS = ("functools", "rlcli.mdp.")
"""Prefixes of modules whose terms keep no state from one episode to the next.

`functools`: a term that is a function is bound as `functools.partial(function, env, ...)`.
"""
_UNIT = re.compile(r"\[([^\]]+)\]")
"""Pattern of the unit in the first line of a term's docstring."""


class TaskLog(Protocol):
    """Interface of the values that the code of a task logs, by the name of the metric."""

    def end_step(self) -> None:
        """Add the present values to the means of the iteration; called once per step, after resets."""

    def iteration_means(self) -> dict[str, Tensor]:
        """Return the means over the steps since the last call. () each"""

    def step_values(self, num_envs: int) -> dict[str, Tensor]:
        """Return the values of this step. (num_envs,) each"""

    def reset_values(self, num_envs: int) -> dict[str, Tensor]:
        """Return the values that the last reset logged about the episodes that ended. (num_envs,) each"""


class ManagedEnv(VecEnv):
    """Environment of a manager-based task.

    A step: actions, physics, terminations, rewards, curriculum and resets, commands, interval events, observations.
    """

    def _prepare_scene(self, scene: Scene) -> None:
        scene.joints.add_actuators(self._actuator_needs())
        if any(getattr(term, "reads_body_forces", False) for term in self._result_terms()):
            add_body_forces(scene.spec)
        for config in self.config.events.values():
            assert config is not None
            term = self._binder.load(self._binder.signature("events", config))
            prepare = getattr(term, "prepare", None)
            if prepare is not None:
                prepare(scene.spec, config.params)

    task_log: TaskLog | None = None
    """Log of a task of another framework, which the plugin of the framework sets; None for other tasks."""
    command_manager: CommandManager
    action_manager: ActionManager
    event_manager: EventManager
    termination_manager: TerminationManager

    def _bind_terms(self) -> None:
        binder, tunable = self._binder, self._binder.tunable
        self._all_envs = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        select_all = self._select_all_by_step
        context = EnvContext(self.num_envs, self.step_dt, self.device, self.engine, tunable, select_all)
        self._context = context
        self._bound: dict[str, list[BoundTerm]] = {}
        # the constructor of a term may look up the terms and the managers of the sections before
        self._bind("commands", CommandManager)
        self._bind("actions", ActionManager)
        self._bind("events", EventManager)
        self._observations = {group: binder.bind_group(group) for group in self.config.observations}
        self._bind("terminations", TerminationManager)
        self._bind("rewards")
        self._bind("curriculum")

    def _bind(self, section: str, manager: Callable[[list[BoundTerm], EnvContext], Any] | None = None) -> None:
        """Resolve the terms of a section such as `rewards`, then create its manager.

        The manager is not created if a term of this section or of an earlier one is wrong.
        """
        self._bound[section] = self._binder.bind_all(section)
        if manager is not None and not self._binder.problems:
            setattr(self, f"{section.removesuffix('s')}_manager", manager(self._bound[section], self._context))

    def _build_workflow(self) -> None:
        # the order matters: the first value of a term may use a manager that was built before
        context, task = self._context, self.config
        if self.event_manager.derives:
            # allocates the constants of each environment, and derives all of them in the same way
            self.engine.set_constants()
        self.event_manager.startup(self._select_all())
        reward_dt = self.step_dt if task.reward_dt_scaling else 1.0
        self.reward_manager = RewardManager(self._bound["rewards"], context, reward_dt, task.divergence_reward)
        self.observation_manager = ObservationManager(self._observations, task.observations, context)
        self.curriculum_manager = CurriculumManager(self._bound["curriculum"], context)

    def stateful_objects(self) -> list[Any]:
        """Return the terms that are objects of classes, whose attributes a step may change."""
        return [term.instance for term in self._terms() if not isinstance(term.instance, functools.partial)]

    def _terms(self) -> list[BoundTerm]:
        return [*itertools.chain(*self._bound.values(), *self._observations.values())]

    def episode_dependencies(self) -> list[str]:
        """Return the keys of the terms and parts that make an episode depend on earlier ones.

        Such a term draws random numbers that depend on the training step, keeps state beyond a reset, or is a class in
        the task's own code, which may do both.
        """
        found = [*super().episode_dependencies(), *(f"actuators.{name}" for name in self.actuators)]
        found += [
            ".".join(map(str, term.path)) for section in ("commands", "curriculum") for term in self._bound[section]
        ]
        for term in self._bound["events"]:
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
        found += [f"actions.{name}" for name, term in self.config.actions.items() if term is not None and term.delay]
        for term in self._terms():
            if not type(term.instance).__module__.startswith(_STATELESS):
                found.append(".".join(map(str, term.path)))
        return list(dict.fromkeys(found))

    def _make_layout(self) -> Layout:
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
        scale = None
        if config.scale is not None:
            columns = config.scale if isinstance(config.scale, list) else [config.scale] * pipeline.width
            scale = tuple(columns) * pipeline.history
        return TermLayout(
            term.name,
            pipeline.size,
            tuple(next(iter(term.elements.values()), [])),
            unit[1] if unit else "",
            scale=scale,
            clip=config.clip,
            history=pipeline.history,
            shape=pipeline.shape if len(pipeline.shape) > 1 else (),
            modifiers=tuple(modifier.model_dump(mode="json") for modifier in config.modifiers),
        )

    def _apply_action(self, action: Tensor) -> None:
        self.action_manager.process(action)

    def _compute_rewards_and_dones(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        terminated, truncated = self.termination_manager.compute(diverged)
        reward = self.reward_manager.compute(diverged, terminated)
        self._guard.require_finite(reward, "the reward")
        self.reward_manager.add_to_episodes()
        if diverged is not None:
            self.reward_manager.replace_diverged(diverged, reward)
        self.command_manager.measure()
        return reward, terminated, truncated

    def _raise_for_term(self, what: str) -> None:
        if what == "the reward":
            self.reward_manager.require_finite_terms()

    def _compute_final_obs(self) -> dict[str, Tensor]:
        rows = None if self.engine.asynchronous else self._select_by_step(self._read_finals)
        return self.observation_manager.compute_final(rows)

    def _episode_returns_and_causes(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        returns, terms = self.reward_manager.episode(ended)
        return returns, terms, self.termination_manager.causes(ended)

    @property
    def reward_names(self) -> list[str]:
        """Names of the reward terms."""
        return [term.name for term in self.reward_manager.terms]

    def _reward_terms(self) -> Tensor:
        return self.reward_manager.step_terms

    def _before_full_reset(self) -> None:
        self.curriculum_manager.advance(self._counters.common_step)  # a reset with a seed sets the step to 0
        self.event_manager.before_full_reset(self._select_all_by_step())

    def _episode_metrics(self, ended: Selection) -> dict[str, Tensor]:
        return self.command_manager.episode(ended)

    def _before_reset(self, ended: Selection) -> None:
        self.curriculum_manager.compute(ended)

    def _reset_workflow(self, selection: Selection) -> None:
        # events first: they write the start states that commands and terms read
        self.event_manager.reset(selection, self._counters.common_step)
        self.action_manager.reset(selection)
        self.command_manager.reset(selection)
        self.reward_manager.reset(selection)
        self.termination_manager.reset(selection)
        self.observation_manager.reset(selection)

    def _update_commands_and_events(self) -> None:
        if self.task_log is not None:
            self.task_log.end_step()
        self.curriculum_manager.advance(self._counters.common_step)
        if not self.event_manager.has_intervals and not self.command_manager.terms:
            return
        running = (self.episode_length_buf > 0).long()  # 0 where the episode has just begun
        self.command_manager.compute(self._select_by_step, running)
        self.sim.command_stamp += 1
        self.event_manager.interval(self._select_by_step, running, self.on_moved)

    def _select_all_by_step(self) -> Selection:
        selection = self._select_by_step(self._all_envs)
        assert selection is not None
        return selection

    def _select_by_step(self, mask: Field) -> Selection | None:
        """Return a selection of the environments where `mask`, (num_envs,), is true; None if there is none.

        The random numbers of this selection depend on the current step, so each step draws new ones.
        """
        counters = self._counters.common_step.expand(self.num_envs)
        return self.engine.select(mask, self.seed, counters.contiguous() if self.engine.asynchronous else counters)

    def _compute_observations(self) -> dict[str, Tensor]:
        return self.observation_manager.compute()

    def _restore_observations(self) -> dict[str, Tensor]:
        return self.observation_manager.recompute_last()

    def metric_values(self) -> dict[str, Tensor]:
        """Return the last values of the curriculum terms, and the values that the task's code logs, by name."""
        logged = {} if self.task_log is None else self.task_log.iteration_means()
        return self.curriculum_manager.values() | logged

    def step_metrics(self) -> dict[str, Tensor]:
        """Return the values that the task's code logged in this step, by name. (num_envs,) each"""
        return {} if self.task_log is None else self.task_log.step_values(self.num_envs)

    def reset_metrics(self) -> dict[str, Tensor]:
        """Return the values that a task logged about the episodes that ended in this step, by name. (num_envs,) each"""
        return {} if self.task_log is None else self.task_log.reset_values(self.num_envs)

    def _workflow_state(self) -> dict[str, Tensor]:
        states = {name: part.state_dict() for name, part in self._parts().items()}
        return {f"{name}.{key}": value for name, state in states.items() for key, value in state.items()}

    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        for name, part in self._parts().items():
            saved = substate(state, f"{name}.")
            if not (isinstance(part, BoundTerm) and part.memory):  # a task's own classes may add attributes
                require_matching_tensors(saved, part.state_dict(), f"env: workflow.{name}")
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
        return {**parts, **{"term." + ".".join(map(str, term.path)): term for term in self._terms()}}

    def markers(self) -> list[Marker]:
        """Return the markers of the commands: shapes, such as arrows, that viewers show."""
        return self.command_manager.markers()

    def unsaved_state(self) -> list[str]:
        """Return the names of the attributes of terms (of classes only) that a checkpoint cannot contain."""
        memories = [term.memory for term in self._terms() if term.memory]
        return [attribute for memory in memories for attribute in memory.unsaved()]

    def _result_terms(self) -> Iterator[Any]:
        """Yield the functions and classes of observations, rewards, terminations and success, before they are bound."""
        task = self.config
        sections = {"rewards": task.rewards, "terminations": task.terminations, "success": task.success}
        groups = [("observations", group.terms) for group in task.observations.values()]
        for section, configs in [*sections.items(), *groups]:
            for config in configs.values():  # type: ignore[attr-defined]
                if config is not None:
                    yield self._binder.load(self._binder.signature(section, config))

    def _actuator_needs(self) -> list[ActuatorNeed]:
        needs = []
        for name, config in self.config.actions.items():
            assert config is not None
            signature = self._binder.signature("actions", config)
            kind = getattr(self._binder.load(signature), "actuator", None)
            joints = next((p.name for p in signature.parameters if p.alias == SELECTORS[0]), None)
            if kind is not None and joints is not None:
                path = ("actions", name, joints)
                needs.append(ActuatorNeed(config.params["entity"], config.params[joints], kind, path))
        return needs


def _action_layout(term: BoundTerm) -> TermLayout:
    action = term.instance
    layout = TermLayout(term.name, action.size, action.elements, action.unit)
    if not hasattr(action, "command_map"):
        return layout
    command: CommandMap = action.command_map()
    return replace(layout, scale=command.scale, clip=command.clip, offset=command.offset, limits=command.limits)
