"""Mirror maps of a task: how its observations and actions change if the world is reflected about the x-z plane.

The map of the action follows from the geometry of the entities (`rlcli.scene.entity_mirror`). Then environments in
random states and their mirror images take the same steps on the CPU engine, with mirrored actions. Their motions and
rewards must stay mirror images of each other. The map of the observations follows from a comparison of the two: each
column of the mirrored observation must equal one column of the same term, or the negative of one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import torch
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.config.schema import GroundConfig, RaySensorConfig
from rlcli.envs.make import make_env
from rlcli.envs.managed import ManagedEnv
from rlcli.errors import ConfigError, TaskError
from rlcli.managers.observation_pipeline import Pipeline
from rlcli.scene.entity import Entity
from rlcli.scene.entity_mirror import QUATERNION, EntityMirror
from rlcli.scene.sensors import RaySensor
from rlcli.sim.rotations import from_euler

_PAIRS, _STEPS = 64, 4
"""Number of random start states of the symmetry test, and number of steps from each start state."""


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """Mirror image of vectors with d columns: column i of the image is `sign[i]` x column `index[i]`."""

    index: Tensor
    sign: Tensor

    def __call__(self, values: Tensor) -> Tensor:
        """Return the mirror image of values. (..., d) -> (..., d)"""
        return values.index_select(-1, self.index) * self.sign

    @property
    def is_identity(self) -> bool:
        """Whether the map changes nothing."""
        return bool((self.index == torch.arange(len(self.index))).all() and (self.sign == 1.0).all())

    def to(self, device: torch.device) -> ColumnMap:
        """Return the map on a device."""
        return ColumnMap(self.index.to(device), self.sign.to(device))


@dataclass(frozen=True, slots=True)
class MirrorMaps:
    """Mirror maps of the observation groups and of the action."""

    observations: dict[str, ColumnMap]
    action: ColumnMap


def mirror_maps(resolved: Resolved, groups: Iterable[str], *, tolerance: float) -> MirrorMaps:
    """Return the mirror maps of a task, after a test that the task is symmetric.

    Args:
        resolved: the task.
        groups: names of the observation groups that need a map.
        tolerance: largest mean difference between a motion, reward or observation and its mirror image, relative to the
            mean size of its changes.

    Raises:
        ConfigError: with the joint, term or column that is not symmetric.
    """
    path = ("agents", resolved.agent_name or "", "symmetry")
    if resolved.source.task is not None:
        raise ConfigError([resolved.problem(path, "a direct task has no terms to mirror", "set symmetry: null")])
    env = make_env(_pairs_on_a_plane(resolved.without_randomness()), shared_streams=_PAIRS)
    assert isinstance(env, ManagedEnv)
    try:
        return _MirrorTest(env, tolerance).run(groups)
    except TaskError as error:
        hint = error.hint or "make the task symmetric, raise symmetry.tolerance or set symmetry: null"
        raise ConfigError([resolved.problem(path, str(error), hint)]) from None
    finally:
        env.close()


def _pairs_on_a_plane(resolved: Resolved) -> Resolved:
    """Return the task as `_MirrorTest` needs it: with 2 x `_PAIRS` environments, and a plane instead of a terrain."""
    scene = resolved.task.scene
    sensors = {
        name: config.model_copy(update={"lookup": False}) if isinstance(config, RaySensorConfig) else config
        for name, config in scene.sensors.items()
    }
    changes: dict[str, Any] = {"num_envs": 2 * _PAIRS, "sensors": sensors}
    if scene.terrain is not None:
        changes |= {"terrain": None, "ground": GroundConfig()}
    return replace(resolved, task=resolved.task.model_copy(update={"scene": scene.model_copy(update=changes)}))


class _MirrorTest:
    """Test in which the second half of the environments are the mirror images of the first half."""

    def __init__(self, env: ManagedEnv, tolerance: float) -> None:
        self._env, self._tolerance, self._random = env, tolerance, torch.Generator().manual_seed(0)
        self._mirrors = {name: EntityMirror(entity) for name, entity in env.entities.items()}
        self._action = self._action_map()

    def run(self, groups: Iterable[str]) -> MirrorMaps:
        """Step both halves, compare them, and return the maps of the action and of the observation groups.

        Raises:
            TaskError: with the joint, term or column that is not symmetric.
        """
        env, size = self._env, self._env.layout.action_size
        env.reset(seed=0)
        self._write_states()
        observed, rewards = [], []
        for _ in range(_STEPS):
            action, before = self._normal_samples(size), env.engine.field("qvel").clone()
            env._apply_action(torch.cat([action, self._action(action)]))
            env._simulate()
            for sensor in env.sensors.values():
                sensor.update(env.step_dt)
            self._compare_motion(before)
            _, terminated, _ = env._compute_rewards_and_dones(None)
            own, images = terminated.float().chunk(2)
            self._require((images - own).abs().mean(), "terminations differ between mirror images")
            rewards.append(env.reward_manager.step_terms.T.clone())
            observed.append({name: obs.clone() for name, obs in env._compute_observations().items()})
        self._compare_rewards(*torch.stack(rewards).chunk(2, dim=1))
        maps = {}
        for group in groups:
            halves = torch.stack([obs[group] for obs in observed]).chunk(2, dim=1)
            maps[group] = self._observation_map(group, *(half.flatten(0, 1) for half in halves))
        if all(each.is_identity for each in (self._action, *maps.values())):
            message = "the mirror changes nothing: everything moves in the x-z plane, so symmetry has no effect"
            raise TaskError(message, hint="set symmetry: null")
        return MirrorMaps(maps, self._action)

    def _normal_samples(self, *shape: int) -> Tensor:
        return torch.randn(_PAIRS, *shape, generator=self._random)

    def _action_map(self) -> ColumnMap:
        """Return the mirror map of the action, each of whose columns must drive one joint."""
        index: list[int] = []
        sign: list[int] = []
        for term in self._env.action_manager.terms:
            start, elements = len(index), term.instance.elements
            entity: Entity | None = getattr(term.instance, "entity", None)
            if entity is None or not set(elements) <= set(entity.joint_names):
                raise TaskError(
                    f"action '{term.name}' ({term.config.func}) does not drive one joint with each column; use"
                    " joint actions"
                )
            for element in elements:
                joint = int(entity.joint_ids[entity.joint_names.index(element)])
                partner, own = self._mirrors[entity.name].joints[joint]
                other = entity.joint_names[entity.joint_ids.tolist().index(partner)]
                if other not in elements:
                    raise TaskError(
                        f"action '{term.name}' drives joint '{element}', but not its mirror image '{other}'; add"
                        f" '{other}'"
                    )
                index.append(start + elements.index(other))
                sign.append(own)
        return ColumnMap(torch.tensor(index), torch.tensor(sign, dtype=torch.float32))

    def _write_states(self) -> None:
        """Write random states, commands and episode times, and their mirror images."""
        env, model = self._env, self._env.engine.model
        qpos, qvel = (env.engine.field(name) for name in ("qpos", "qvel"))
        qpos[:_PAIRS] += 0.3 * self._normal_samples(model.nq)
        qvel[:_PAIRS] = self._normal_samples(model.nv).double()
        for joint, kind in enumerate(model.jnt_type):
            start = int(model.jnt_qposadr[joint])
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                height = env.default_state["qpos"][start + 2]
                qpos[:_PAIRS, start + 2] = height * (0.85 + 0.4 * torch.rand(_PAIRS, generator=self._random))
                turn = 0.7 * self._normal_samples(3).double()
                turn[: _PAIRS // 2] *= 3.0  # half of the robots lie on the ground
                qpos[:_PAIRS, start + 3 : start + 7] = from_euler(*turn.unbind(1))
            elif model.jnt_limited[joint]:
                qpos[:_PAIRS, start].clamp_(*model.jnt_range[joint].tolist())
        for mirror in self._mirrors.values():
            mirror.reflect(qpos[:_PAIRS], qvel[:_PAIRS], qpos[_PAIRS:], qvel[_PAIRS:])
        env.episode_length_buf[:_PAIRS] = torch.arange(_PAIRS) % env.max_episode_length
        env.episode_length_buf[_PAIRS:] = env.episode_length_buf[:_PAIRS]
        for term in env.command_manager.terms:
            command, signs = term.instance.command, getattr(term.instance, "mirror_signs", None)
            if signs is None:
                raise TaskError(
                    f"command '{term.name}' ({term.config.func}) has no mirror image; give its class an attribute"
                    " mirror_signs: +1 or -1 for each column of the command"
                )
            command[:_PAIRS] = self._normal_samples(command.shape[1])
            if tuple(signs[3:]) == QUATERNION:
                command[:_PAIRS, 3:] = torch.nn.functional.normalize(command[:_PAIRS, 3:], dim=1)
            command[_PAIRS:] = command[:_PAIRS] * torch.tensor(signs)
        env.sim.command_stamp += 1  # terms compute goals again
        env.on_moved(env._select_all())
        env.sim.forward_moved()

    def _compare_motion(self, before: Tensor) -> None:
        """Compare the changes of the joint velocities with the changes in the mirror images. before (num_envs, nv)"""
        env, model = self._env, self._env.engine.model
        qpos, qvel = (env.engine.field(name) for name in ("qpos", "qvel"))
        image_qpos, image = qpos[_PAIRS:].clone(), qvel[_PAIRS:].clone()
        for mirror in self._mirrors.values():
            mirror.reflect(qpos[:_PAIRS], qvel[:_PAIRS], image_qpos, image)
        error = _relative(image - qvel[_PAIRS:], qvel[_PAIRS:] - before[_PAIRS:])
        free = torch.tensor(model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_FREE)
        # an asymmetric leg also turns the root: name the leg
        worst = int(torch.where(free & bool((error[~free] > self._tolerance).any()), 0.0, error).argmax())
        joint = int(model.dof_jntid[worst])
        partner = next(m.joints[joint][0] for m in self._mirrors.values() if joint in m.joints)
        first, second = sorted((model.joint(joint).name, model.joint(partner).name))
        self._require(error[worst], f"joints '{first}' and '{second}' do not move as mirror images: velocities differ")

    def _compare_rewards(self, own: Tensor, images: Tensor) -> None:
        error = _relative((images - own).flatten(0, 1), own.flatten(0, 1))
        if len(error):
            name = self._env.reward_names[int(error.argmax())]
            self._require(error.max(), f"reward '{name}' differs between mirror images")

    def _require(self, error: Tensor, what: str) -> None:
        if not float(error) <= self._tolerance:
            found = f"{float(error):.2%}; symmetry.tolerance allows {self._tolerance:.2%}"
            raise TaskError(f"mirrored environments disagree: {what} by {found}")

    def _observation_map(self, group: str, own: Tensor, images: Tensor) -> ColumnMap:
        index, sign, start = [], [], 0
        for pipeline in self._env.observation_manager.pipelines(group):
            width, stop = pipeline.width, start + pipeline.size
            columns = slice(stop - width, stop)  # the newest frame of a history
            found = self._term_map(f"{group}.{pipeline.term.name}", pipeline, own[:, columns], images[:, columns])
            for frame in range(start, stop, width):
                index += [frame + column for column, _ in found]
                sign += [own_sign for _, own_sign in found]
            start = stop
        mapped = ColumnMap(torch.tensor(index), torch.tensor(sign, dtype=torch.float32))
        error = _relative(mapped(own) - images, images)
        self._require(
            error.max(), f"column {int(error.argmax())} of observation group '{group}' differs from its mirror image"
        )
        return mapped

    def _term_map(self, name: str, pipeline: Pipeline, own: Tensor, images: Tensor) -> list[tuple[int, float]]:
        """Return, for each column of a term, (index, sign): column i of the image is `sign` x column `index`."""
        if len(pipeline.shape) > 1:
            raise TaskError(f"observation '{name}' is an image and has no mirror map; remove the image from the group")
        rays = _ray_partners(pipeline)
        if rays is not None:
            return [(partner, 1.0) for partner in rays]
        found = []
        for column, image in enumerate(images.unbind(1)):
            place = f"column {column} of observation '{name}'"
            if image.max() == image.min():
                raise TaskError(
                    f"the sign of {place} in the mirror is unknown: its value is {float(image[0]):g} in all tested"
                    " states; remove the column, or make its value vary"
                )
            errors = torch.stack([_relative(image[:, None] - s * own, image[:, None].expand_as(own)) for s in (1, -1)])
            fits = (errors <= self._tolerance).nonzero().tolist()
            if len(fits) != 1:
                nearest = f"equals no column of the term (the nearest differs by {float(errors.min()):.2%})"
                matches = "equals several columns of the term: remove the equal columns" if fits else nearest
                raise TaskError(f"the mirror image of {place} {matches}")
            found.append((fits[0][1], 1.0 - 2.0 * fits[0][0]))
        return found


def _relative(difference: Tensor, values: Tensor) -> Tensor:
    """Return the mean absolute difference of each column, divided by its mean absolute deviation. (n, d) -> (d,)"""
    deviation = (values - values.mean(dim=0)).abs().mean(dim=0)
    return difference.abs().mean(dim=0) / (deviation + 1e-6 * values.abs().mean(dim=0) + 1e-9)


def _ray_partners(pipeline: Pipeline) -> list[int] | None:
    """Return, for each ray of the term's ray sensor, the index of the ray that is its mirror image.

    Return None if the columns of the term are not the rays of a sensor.
    """
    call = pipeline.term.instance
    parameters = getattr(call, "keywords", None) or vars(call)
    for sensor in parameters.values():
        if isinstance(sensor, RaySensor) and len(sensor.names) == pipeline.width:
            return sensor.mirror_partners()
    return None
