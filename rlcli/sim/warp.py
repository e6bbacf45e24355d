"""The GPU engine, on MuJoCo Warp: every world in one launch, float32, fit for capture in a CUDA graph.

It also runs on Warp's CPU device, slowly: that is how its tests run where there is no GPU. Results are not
bit-identical from run to run (atomic additions).
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from rlcli.errors import did_you_mean
from rlcli.sim import kernels
from rlcli.sim.capacity import Capacity
from rlcli.sim.columns import as_index
from rlcli.sim.engine import force_sensors
from rlcli.sim.guard import LIMIT, Call, Divergence, StateLayout
from rlcli.sim.mask import MaskSelection
from rlcli.sim.mjcf import quiet_mujoco
from rlcli.sim.room import FULL, overflow, put
from rlcli.sim.saved import require_alike
from rlcli.sim.selection import ALL, Field, Selection
from rlcli.sim.stages import FORCE, INPUTS, KINEMATICS, STATE, VELOCITY, Stages

_CONSTANTS = (
    *("body_subtreemass", "dof_invweight0", "body_invweight0", "tendon_invweight0", "tendon_length0"),
    *("actuator_acc0", "eq_data"),
)
"""Model fields that `set_const` derives from others."""
_BOUNDS = ("geom_aabb", "geom_rbound")
"""Those that it derives from the sizes of geoms."""


_HOLDS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
"""Equality constraints that hold bodies together."""


_Groups = wp.types.vector(length=mujoco.mjNGROUP, dtype=float)


class WarpEngine:
    """Many worlds of one model on a GPU.

    Args:
        model: the compiled model.
        num_envs: worlds.
        device: cuda, cuda:N, or cpu.
        capacity: room for contacts and constraints in a world.
        forces_after_reset: whether `forward` computes the acceleration stage, or leaves zeros there.
        late: derived fields are left as the last substep made them.
        external_forces: compute `cfrc_ext`, which MuJoCo Warp does for models with certain sensors alone.
        max_velocity: a velocity beyond it is a divergence [m/s, rad/s].

    Raises:
        ConfigError: for a model that MuJoCo Warp cannot run.
        DeviceError: for more worlds than the device's memory holds.
    """

    threads = 1
    asynchronous = True

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        device: str,
        capacity: Capacity,
        forces_after_reset: bool = True,
        *,
        late: bool = False,
        external_forces: bool = False,
        max_velocity: float = LIMIT,
    ) -> None:
        quiet_mujoco()
        self.model = model
        self.num_envs = num_envs
        self.lives = 0
        self.device = torch.device(device)
        self.capacity = capacity
        self.warnings: dict[str, int] = {}
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self._device = wp.device_from_torch(self.device)
        self._fields: dict[str, Tensor] = {}
        self._watched: list[str] = []
        self._start_inputs: dict[str, Tensor] = {}
        self._last_derived: dict[str, Tensor] = {}
        self._derived: set[int] = set()
        self._motion_alone = True
        self._overwritten: dict[str, wp.array] = {}
        self.forces_after_reset = forces_after_reset
        self._late = late
        self._external_forces = external_forces
        self._max_velocity = max_velocity
        self._stages = Stages(model)
        self._force_columns = as_index(force_sensors(model), self.device)
        self._holds_bodies = bool(np.isin(model.eq_type, _HOLDS).any())
        self._expanded: dict[str, Tensor] = {}
        self._graphs: dict[tuple[int, bool], Any] = {}
        self._rays: dict[tuple[int, int], tuple[wp.array, wp.array, wp.array]] = {}
        self._worlds: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}
        with wp.ScopedDevice(self._device), _on_torch_stream(self.device):
            self._model, self._data = put(model, num_envs, self.device, capacity)
            self._arrays = {name: getattr(self._data, name) for name in STATE}
            qpos, qvel, _ = (self.field(name) for name in ("qpos", "qvel", "qacc_warmstart"))
            self._last_qpos, self._last_qvel = qpos.clone(), qvel.clone()
            self._default_qpos = torch.tensor(model.qpos0, dtype=torch.float32, device=self.device)
            self._default_qvel = torch.zeros(model.nv, device=self.device)
            self._diverged = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
            self._counts = torch.zeros(len(kernels.CAUSES), dtype=torch.int64, device=self.device)
            self._first = torch.zeros(3, dtype=torch.int32, device=self.device)
            self._overflowed = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
            self._flags = torch.zeros(16, dtype=torch.int32, device=self.device)

    @property
    def divergences(self) -> int:
        """Worlds that diverged, ever; waits for the device."""
        return int(self._counts.sum())

    @property
    def causes(self) -> dict[str, int]:
        """The same by cause; waits for the device."""
        return {name: count for name, count in zip(kernels.CAUSES, self._counts.tolist(), strict=True) if count}

    @property
    def found(self) -> list[Divergence]:
        """The first world that ever diverged; waits for the device."""
        world, cause, column = self._first.tolist()
        if not world:
            return []
        name = kernels.CAUSES[cause]
        return [Divergence(world - 1, name, StateLayout(self.model, {}).place(name.split()[0], column))]

    def remember(self, calls: int, memory: int = 0) -> None:
        """Nothing is kept: no replay gives the bits of a GPU again."""

    def trace(self, env: int) -> list[Call]:
        """Nothing."""
        return []

    def attach(self) -> None:
        """Let Warp launch on torch's current stream, so that the two take turns."""
        if self.device.type == "cuda":
            stream = torch.cuda.current_stream(self.device)
            if self._device.stream.cuda_stream != stream.cuda_stream:
                wp.set_stream(wp.stream_from_torch(stream), self._device)

    def field(self, name: str) -> Tensor:
        """A live view of an MjData field; binding a derived one makes `step` compute its stage."""
        if name not in self._fields:
            array = getattr(self._data, name, None)
            if not isinstance(array, wp.array) or array.ndim == 0 or array.shape[0] != self.num_envs:
                known = [f.name for f in dataclasses.fields(self._data)]
                raise ValueError(f"'{name}' is not a field of MuJoCo Warp's data; {did_you_mean(name, known) or ''}")
            kept = self._before_forward()
            self._fields[name] = wp.to_torch(array)
            if name in INPUTS:  # nobody has written to it yet
                self._start_inputs[name] = self._fields[name].view(self.num_envs, -1).clone()
            self._derived |= self._stages.of(name)
            self._motion_alone = all(map(self._stages.is_motion, self._fields))
            if name in ("cacc", "cfrc_int"):  # the velocity stage uses their memory for its own accelerations
                self._overwritten[name] = wp.empty_like(array)
            self._graphs.clear()
            if self._stages.of(name):
                with self._launching():
                    self._catch_up()
                    mjw.forward(self._model, self._data)  # a field asked for late is that of the state
                for other, values in kept.items():
                    self._fields[other].copy_(values)
                if FORCE in self._stages.of(name) or (self._late and self._fields[name].dtype == torch.float32):
                    self._last_derived[name] = self._fields[name].clone()
        return self._fields[name]

    def can_expand(self, name: str) -> bool:
        """Whether a model field may differ between worlds."""
        owner, attribute = self._owner(name)
        return attribute in _batched(owner) and getattr(owner, attribute, None) is not None

    def expand(self, name: str) -> Tensor:
        """A model field with a value for every world."""
        if name not in self._expanded:
            owner, attribute = self._owner(name)
            batched = _batched(owner)
            if not self.can_expand(name):
                raise ValueError(f"'{name}' cannot differ between worlds; {did_you_mean(attribute, batched) or ''}")
            array = getattr(owner, attribute)
            values = np.repeat(array.numpy()[:1], self.num_envs, axis=0)
            wide = wp.array(values, dtype=array.dtype, device=self._device)
            setattr(owner, attribute, wide)
            self._expanded[name] = wp.to_torch(wide)
            self._graphs.clear()
        return self._expanded[name]

    def expanded(self, name: str) -> Tensor | None:
        """The same where somebody has asked for it before; None where all worlds share the model's value."""
        return self._expanded.get(name)

    def expansions(self) -> list[str]:
        """The model fields that somebody has asked for."""
        return list(self._expanded)

    def set_constants(self, selection: Selection | None = None) -> None:
        """Let the constants that MuJoCo derives from model fields follow what was written to expanded ones."""
        for name in (*_CONSTANTS, *(_BOUNDS if "geom_size" in self._expanded else ())):
            array = getattr(self._model, name, None)
            if array is not None and array.size:
                self.expand(name)
        with self._launching():
            mjw.set_const(self._model, self._data)

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; without `derive` the derived fields stay behind."""
        with self._launching():
            if self.device.type != "cuda" or torch.cuda.is_current_stream_capturing():
                self._advance(nstep, derive)
            elif (nstep, derive) in self._graphs:
                wp.capture_launch(self._graphs[nstep, derive])
            else:
                self._advance(nstep, derive)  # compiles
                self._graphs[nstep, derive] = self._capture(nstep, derive)

    def diverged(self, moves_finitely: bool = False) -> Tensor:
        """Worlds that the last step drove out of bounds; they are back in the state before it, at rest. (num_envs,)

        What is bound of the derived fields is that of the state before, too: terms judge by it.
        """
        with self._launching():
            for name, last in self._last_derived.items():
                self._launch_rows(kernels.hold, self._diverged, self._fields[name], last)
        return self._diverged

    def forward(self, selection: Selection) -> None:
        """Compute what is bound of the derived fields; of the acceleration stage for the selected worlds only.

        What a selected world is now is what it goes back to if it diverges.
        """
        assert isinstance(selection, MaskSelection)
        self._forward(selection)
        fields = [(self.field("qpos"), self._last_qpos), (self.field("qvel"), self._last_qvel)]
        fields += [(self._fields[name], last) for name, last in self._last_derived.items()]
        with self._launching():
            for now, last in fields:
                self._launch_rows(kernels.remember, selection.mask, now, last)

    def reset(self, selection: Selection) -> None:
        """Put the selected worlds into the default state, applied forces included."""
        assert isinstance(selection, MaskSelection)
        with self._launching():
            wp.launch(
                kernels.reset,
                dim=self.num_envs,
                inputs=[
                    wp.from_torch(selection.mask),
                    wp.from_torch(self._default_qpos),
                    wp.from_torch(self._default_qvel),
                ],
                outputs=[self._arrays[name] for name in STATE[:2]]
                + [self._arrays[name] for name in ("qacc_warmstart", "ctrl", "act", "time")],
                device=self._device,
            )
        for name, start in self._start_inputs.items():
            selection.write(self._fields[name].view(self.num_envs, -1), start)
        if not self.forces_after_reset:
            for name in self._of_substep():  # no force has acted on a start state yet
                columns = self._force_columns if name == "sensordata" else ALL
                selection.write(self._fields[name].view(self.num_envs, -1), 0.0, columns)

    def set_default(self, qpos: Tensor, qvel: Tensor) -> None:
        """The joint state that `reset` restores."""
        self._default_qpos.copy_(qpos)
        self._default_qvel.copy_(qvel)

    def as_field(self, tensor: Tensor) -> Tensor:
        """The tensor itself."""
        return tensor

    def select(self, mask: Field, seed: int, counters: Field) -> MaskSelection:
        """The worlds where `mask` holds; whether there are any is known to the device alone."""
        assert isinstance(mask, Tensor)
        assert isinstance(counters, Tensor)
        return MaskSelection(mask, seed, counters, lives=self.lives)

    def rays(
        self,
        points: Tensor,
        directions: Tensor,
        *,
        groups: tuple[int, ...] | None = None,
        exclude: int = -1,
        selection: Selection | None = None,
    ) -> Tensor:
        """Distances from points to the first geom along unit directions, -1 where there is none. (num_envs, rays)"""
        self.field("geom_xpos")  # current from now on
        shape = (self.num_envs, points.shape[1])
        distance = torch.empty(shape, device=self.device)
        with self._launching():
            excluded, geom, normal = self._ray_buffers(points.shape[1], exclude)
            seen = _Groups(*(-1.0 if groups is None else float(g in groups) for g in range(mujoco.mjNGROUP)))
            pnt, vec = (wp.from_torch(v.expand(*shape, 3).contiguous(), dtype=wp.vec3) for v in (points, directions))
            mjw.rays(
                self._model, self._data, pnt, vec, seen, True, excluded, wp.from_torch(distance), geom, normal
            )  # fmt: skip
        return distance

    def watch(self, values: Tensor, what: str) -> None:
        """Have the device note if a value is not finite; `noted` tells."""
        if what not in self._watched:
            self._watched.append(what)
            if len(self._watched) > len(self._flags):
                self._flags = torch.cat([self._flags, torch.zeros_like(self._flags)])
        with self._launching():
            flat = values.view(len(values), -1) if values.is_contiguous() else values.contiguous().view(len(values), -1)
            inputs = [wp.from_torch(flat), wp.from_torch(self._flags), self._watched.index(what)]
            wp.launch(kernels.watch, dim=tuple(flat.shape), inputs=inputs, device=self._device)

    def noted(self) -> list[str]:
        """What was not finite since the last call. Also looks whether contacts or constraints ran out of room.

        Raises:
            DivergedError: naming the setting to raise, if they did.
        """
        flags = self._flags.tolist()
        found = 0
        for bit in FULL:
            found |= int(bit) if bool((self._overflowed & int(bit)).any()) else 0
        if found:
            self._overflowed.zero_()
            raise overflow(found, self.capacity)
        if any(flags):
            self._flags.zero_()
        return [what for what, flag in zip(self._watched, flags, strict=False) if flag]

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of the state, of bound inputs and of the model fields that differ between worlds."""
        inputs = [name for name in INPUTS if name in self._fields]
        return {
            **{name: self.field(name).clone() for name in (*STATE, *inputs)},
            "last_qpos": self._last_qpos.clone(),
            "last_qvel": self._last_qvel.clone(),
            **{f"model.{name}": values.clone() for name, values in self._expanded.items()},
            **{f"substep.{name}": self.field(name).clone() for name in self._of_substep()},
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `state_dict` gave; derived fields are computed anew."""
        for name, values in state.items():
            if name.startswith("model."):
                field = name.removeprefix("model.")
                if not values.is_floating_point() and self.expanded(field) is None:
                    raise ValueError(f"model field '{field}' is part of the model's structure, and not the model's")
                require_alike({field: values}, {field: self.expand(field)}, "engine")
                self.expand(field).copy_(values)
        for name in state:
            if name.startswith("substep."):
                self.field(name.removeprefix("substep."))  # whoever saved had asked for it; here that may come later
        for name, values in state.items():
            if name in (*STATE, *INPUTS):
                self.field(name).copy_(values)
        self._last_qpos.copy_(state["last_qpos"])
        self._last_qvel.copy_(state["last_qvel"])
        with self._launching():
            self._derive()
        for name, values in state.items():
            if name.startswith("substep."):
                self.field(name.removeprefix("substep.")).copy_(values)
        for name, last in self._last_derived.items():
            last.copy_(self._fields[name])

    def world(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One world as MjModel and MjData, forwarded; asked again for the same world, the same two objects, updated."""
        if env not in self._worlds:
            model = copy.copy(self.model)
            self._worlds[env] = (model, mujoco.MjData(model))
        model, data = self._worlds[env]
        for name, values in self._expanded.items():
            owner, attribute = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
            value = values[env].cpu().numpy()
            if np.ndim(getattr(owner, attribute)):
                getattr(owner, attribute)[:] = value.reshape(getattr(owner, attribute).shape)
            else:
                setattr(owner, attribute, float(value))
        for name in (*STATE[:-1], *(n for n in INPUTS if n in self._fields)):
            target = getattr(data, name)
            target[:] = self.field(name)[env].cpu().numpy().reshape(target.shape)
        data.time = float(self.field("time")[env])
        mujoco.mj_forward(model, data)
        return model, data

    def close(self) -> None:
        """Let go of the captured graphs; the memory goes with the object."""
        self._graphs.clear()

    @contextlib.contextmanager
    def _launching(self) -> Any:
        with wp.ScopedDevice(self._device):
            yield

    def _advance(self, nstep: int, derive: bool) -> None:
        for _ in range(nstep):
            self._catch_up()
            mjw.step(self._model, self._data)
        if derive and self._external_forces:
            mjw.rne_postconstraint(self._model, self._data)
        if derive:
            self._guard()
        if derive and not self._late:
            self._derive()

    def _catch_up(self) -> None:
        """Compute the velocities of bodies before constraints are made of them.

        MuJoCo Warp 4.0 makes connect and weld constraints first, of the velocities that the last pass left: those of
        the step before, or of the episode before.
        """
        if self._holds_bodies:
            mjw.fwd_kinematics(self._model, self._data)
            mjw.com_vel(self._model, self._data)

    def _guard(self) -> None:
        """Put worlds that have left all bounds back, before anything is derived from where they are."""
        wp.launch(
            kernels.guard,
            dim=self.num_envs,
            inputs=[self._arrays[name] for name in ("qpos", "qvel", "qacc_warmstart", "ctrl", "act")]
            + [self._data.overflow, self._max_velocity],
            outputs=[
                wp.from_torch(self._last_qpos),
                wp.from_torch(self._last_qvel),
                wp.from_torch(self._diverged),
                wp.from_torch(self._counts),
                wp.from_torch(self._first),
                wp.from_torch(self._overflowed),
            ],
            device=self._device,
        )

    def _derive(self) -> None:
        """Bring the derived fields that somebody reads up to the state; those of forces are the last substep's."""
        m, d = self._model, self._data
        if VELOCITY in self._derived and self._motion_alone:
            mjw.fwd_kinematics(m, d)
            mjw.com_vel(m, d)
            if "sensordata" in self._fields:
                mjw.sensor_pos(m, d)
                mjw.sensor_vel(m, d)
        elif VELOCITY in self._derived:
            self._catch_up()
            mjw.fwd_position(m, d, factorize=False)
            for name, kept in self._overwritten.items():
                wp.copy(kept, getattr(d, name))
            mjw.fwd_velocity(m, d)
            for name, kept in self._overwritten.items():
                wp.copy(getattr(d, name), kept)
            if "sensordata" in self._fields:
                mjw.sensor_pos(m, d)
                mjw.sensor_vel(m, d)
        elif KINEMATICS in self._derived:
            mjw.fwd_kinematics(m, d)

    def _owner(self, name: str) -> tuple[Any, str]:
        return (self._model.opt, name[4:]) if name.startswith("opt.") else (self._model, name)

    def _of_substep(self) -> list[str]:
        return [name for name in self._fields if FORCE in (stages := self._stages.of(name)) or (self._late and stages)]

    def _forward(self, selection: Selection) -> None:
        if not self._late and (FORCE not in self._derived or not self.forces_after_reset):
            with self._launching():
                self._derive()
            return
        before = self._before_forward()
        with self._launching():
            self._catch_up()
            mjw.forward(self._model, self._data)
        for name, old in before.items():
            now = self.field(name)
            new = now.clone()
            now.copy_(old)
            selection.write(now, new)
        if self._external_forces and "cfrc_ext" in before:  # no contact has acted on a start state yet
            selection.write(self._fields["cfrc_ext"], 0.0)

    def _launch_rows(self, kernel: wp.Kernel, mask: Tensor, now: Tensor, last: Tensor) -> None:
        flat = [wp.from_torch(values.view(self.num_envs, -1)) for values in (now, last)]
        wp.launch(kernel, dim=flat[0].shape, inputs=[wp.from_torch(mask), *flat], device=self._device)

    def _ray_buffers(self, rays: int, exclude: int) -> tuple[wp.array, wp.array, wp.array]:
        """What a cast needs beside the rays, made once: the body each ray ignores, geoms and normals that are hit."""
        if (rays, exclude) not in self._rays:
            shape = (self.num_envs, rays)
            self._rays[rays, exclude] = (
                wp.full(rays, exclude, dtype=int),
                wp.empty(shape, dtype=int),
                wp.empty(shape, dtype=wp.vec3),
            )
        return self._rays[rays, exclude]

    def _before_forward(self) -> dict[str, Tensor]:
        """Copies of what a forward pass would overwrite, and which is the last substep's."""
        return {
            name: self._fields[name].clone() for name in (*self._of_substep(), "qacc_warmstart") if name in self._fields
        }

    def _capture(self, nstep: int, derive: bool) -> Any:
        stream = wp.Stream(self._device)  # torch's default stream cannot be recorded
        with wp.ScopedStream(stream), wp.ScopedCapture(stream=stream, force_module_load=False) as capture:
            self._advance(nstep, derive)
        return capture.graph


@contextlib.contextmanager
def _on_torch_stream(device: torch.device) -> Any:
    if device.type != "cuda":
        yield
        return
    with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device))):
        yield


def _batched(owner: Any) -> set[str]:
    return {f.name for f in dataclasses.fields(owner) if _is_batched(f.type)}


def _is_batched(kind: Any) -> bool:
    return next(iter(getattr(kind, "shape", ())), None) == "*"
