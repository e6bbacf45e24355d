"""GPU engine on MuJoCo Warp, which steps all worlds together, in float32; its steps can be part of a CUDA graph.

The engine also runs on Warp's CPU device, slowly, for tests on machines without a GPU. Results are not bit-identical
from run to run, because MuJoCo Warp adds with atomic operations.
"""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from rlcli.config.schema import SimConfig
from rlcli.sim import warp_kernels
from rlcli.sim.acceleration_fields import force_sensor_columns
from rlcli.sim.column_views import as_index
from rlcli.sim.divergence_report import STATE_LIMIT, Divergence, StateLayout
from rlcli.sim.env_selection import ALL, Field, Groups, Selection
from rlcli.sim.gpu_env_selection import MaskSelection
from rlcli.sim.warp_allocation import OVERFLOW_SETTINGS, overflow_error
from rlcli.sim.warp_field_stages import FORCE, STATE
from rlcli.sim.warp_world_state import WarpWorlds

_GroupFlags = wp.types.vector(length=mujoco.mjNGROUP, dtype=float)


class WarpEngine(WarpWorlds):
    """Engine that steps many worlds of one model on a GPU.

    Args:
        model: the compiled model.
        num_envs: number of worlds.
        config: configuration of the simulation. With `external_forces`, `cfrc_ext` is computed for every model; MuJoCo
            Warp itself computes it only for models with certain sensors.
        device: cuda, cuda:N, or cpu.

    Raises:
        ConfigError: for a model that MuJoCo Warp cannot run.
        DeviceError: for more worlds than the device's memory holds.
    """

    threads = 1
    asynchronous = True
    replayable = None
    """None, because steps on a GPU are not bit-identical when they are repeated."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: SimConfig, device: str) -> None:
        super().__init__(model, num_envs, config, device)
        self.shared_streams = 0
        self.warnings: dict[str, int] = {}
        self.forces_after_reset = config.forces_after_reset
        self._external_forces = config.external_forces
        self._max_velocity = config.max_velocity or STATE_LIMIT
        self._force_columns = as_index(force_sensor_columns(model), self.device)
        self._ray_buffers: dict[tuple[int, int], tuple[wp.array, wp.array, wp.array]] = {}
        """(number of rays, excluded body) -> buffers of `rays`: excluded body, geom and normal of each ray."""
        self._checked: list[str] = []
        """Names of the values passed to `check_finite`; the index of a name is the index of its flag."""
        with self._setting_up():
            self._default_qpos = torch.tensor(model.qpos0, dtype=torch.float32, device=self.device)
            self._default_qvel = torch.zeros(model.nv, device=self.device)
            self._diverged = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
            self._counts = torch.zeros(len(warp_kernels.CAUSES), dtype=torch.int64, device=self.device)
            self._first = torch.zeros(3, dtype=torch.int32, device=self.device)
            self._overflowed = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
            self._flags = torch.zeros(16, dtype=torch.int32, device=self.device)

    @property
    def divergence_causes(self) -> dict[str, int]:
        """Number of divergences since the start, by cause; reading the property forces a host sync."""
        return {name: count for name, count in zip(warp_kernels.CAUSES, self._counts.tolist(), strict=True) if count}

    @property
    def described_divergences(self) -> list[Divergence]:
        """First divergence since the start, or an empty list; reading the property forces a host sync."""
        world, cause, column = self._first.tolist()
        if not world:
            return []
        name = warp_kernels.CAUSES[cause]
        return [Divergence(world - 1, name, StateLayout(self.model, {}).element_at(name.split()[0], column))]

    def use_torch_stream(self) -> None:
        """Launch Warp's kernels on torch's current stream, so that kernels of both run in order."""
        if self.device.type == "cuda":
            stream = torch.cuda.current_stream(self.device)
            if self._device.stream.cuda_stream != stream.cuda_stream:
                wp.set_stream(wp.stream_from_torch(stream), self._device)

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; then, with `derive`, update derived fields such as xpos."""
        with self._launching():
            if self.device.type != "cuda" or torch.cuda.is_current_stream_capturing():
                self._advance(nstep, derive)
            elif (nstep, derive) in self._graphs:
                wp.capture_launch(self._graphs[nstep, derive])
            else:
                self._advance(nstep, derive)  # compiles
                self._graphs[nstep, derive] = self._capture(nstep, derive)

    def diverged(self, motion_is_finite: bool = False) -> Tensor:
        """Return whether each world diverged in the last step, (num_envs,) bool.

        `step` has already given these worlds their state before the step, with controls and warm start set to 0. This
        method also restores their requested derived fields.
        """
        with self._launching():
            for name, last in self._last_derived.items():
                self._launch_rows(warp_kernels.restore_diverged, self._diverged, self._fields[name], last)
        return self._diverged

    def forward(self, selection: Selection) -> None:
        """Compute the requested derived fields (xpos, ...); forces and accelerations only in the selected worlds.

        The present state of the selected worlds is saved; it is restored in worlds that diverge in the next step.
        """
        assert isinstance(selection, MaskSelection)
        self._forward(selection)
        fields = [(self.field("qpos"), self._last_qpos), (self.field("qvel"), self._last_qvel)]
        fields += [(self._fields[name], last) for name, last in self._last_derived.items()]
        with self._launching():
            for now, last in fields:
                self._launch_rows(warp_kernels.save_rows, selection.mask, now, last)

    def reset(self, selection: Selection) -> None:
        """Set the selected worlds to the default state, including applied forces."""
        assert isinstance(selection, MaskSelection)
        inputs = [wp.from_torch(tensor) for tensor in (selection.mask, self._default_qpos, self._default_qvel)]
        state = [self._arrays[name] for name in STATE]
        with self._launching():
            wp.launch(warp_kernels.reset_worlds, self.num_envs, inputs, state, device=self._device)
        for name, start in self._start_inputs.items():
            selection.write(self._fields[name].view(self.num_envs, -1), start)
        if not self.forces_after_reset:
            for name in self._of_substep():  # no force has acted on a start state yet
                columns = self._force_columns if name == "sensordata" else ALL
                selection.write(self._fields[name].view(self.num_envs, -1), 0.0, columns)

    def set_default_state(self, qpos: Tensor, qvel: Tensor) -> None:
        """Set the positions and velocities that `reset` restores. (nq,), (nv,)"""
        self._default_qpos.copy_(qpos)
        self._default_qvel.copy_(qvel)

    def as_field(self, tensor: Tensor) -> Tensor:
        """Return the tensor itself, which selections of this engine read and write."""
        return tensor

    def select(self, mask: Field, seed: int, counters: Field) -> MaskSelection:
        """Return a selection of the worlds where `mask` is true, which may be empty; see `Engine.select`."""
        assert isinstance(mask, Tensor)
        assert isinstance(counters, Tensor)
        return MaskSelection(mask, seed, counters, shared_streams=self.shared_streams)

    def rays(
        self, points: Tensor, directions: Tensor, *, groups: Groups, exclude: int, selection: Selection | None
    ) -> Tensor:
        """Return the distance to the first geom on each ray, -1 without a hit (`Engine.rays`). (num_envs, rays) [m]"""
        self.field("geom_xpos")  # requests the field, so that every step updates the positions of geoms
        shape = (self.num_envs, points.shape[1])
        distance = torch.empty(shape, device=points.device)
        visible = _GroupFlags(*(-1.0 if groups is None else float(g in groups) for g in range(mujoco.mjNGROUP)))
        pnt, vec = (wp.from_torch(v.expand(*shape, 3).contiguous(), dtype=wp.vec3) for v in (points, directions))
        with self._launching():
            if (shape[1], exclude) not in self._ray_buffers:
                bodies, geoms = wp.full(shape[1], exclude, dtype=int), wp.empty(shape, dtype=int)
                self._ray_buffers[shape[1], exclude] = bodies, geoms, wp.empty(shape, dtype=wp.vec3)
            excluded, geom, normal = self._ray_buffers[shape[1], exclude]
            out = wp.from_torch(distance)
            mjw.rays(self._model, self._data, pnt, vec, visible, True, excluded, out, geom, normal)
        return distance

    def check_finite(self, values: Tensor, what: str) -> None:
        """Launch a check of whether all values are finite; `report_nonfinite` returns its result."""
        if what not in self._checked:
            self._checked.append(what)
            if len(self._checked) > len(self._flags):
                self._flags = torch.cat([self._flags, torch.zeros_like(self._flags)])
        with self._launching():
            flat = values.contiguous().view(len(values), -1)
            inputs = [wp.from_torch(flat), wp.from_torch(self._flags), self._checked.index(what)]
            wp.launch(warp_kernels.flag_nonfinite, dim=tuple(flat.shape), inputs=inputs, device=self._device)

    def report_nonfinite(self) -> list[str]:
        """Return the names of the values that were not finite since the last call.

        Raises:
            DivergedError: if contacts or constraints exceeded their capacity; the hint has the setting to raise.
        """
        flags = self._flags.tolist()
        found = sum(int(bit) for bit in OVERFLOW_SETTINGS if bool((self._overflowed & int(bit)).any()))
        if found:
            self._overflowed.zero_()
            raise overflow_error(found, self.capacity)
        if any(flags):
            self._flags.zero_()
        return [what for what, flag in zip(self._checked, flags, strict=False) if flag]

    def close(self) -> None:
        """Drop the captured CUDA graphs; Python frees the memory."""
        self._graphs.clear()

    def _advance(self, nstep: int, derive: bool) -> None:
        for _ in range(nstep):
            self._update_velocities()
            mjw.step(self._model, self._data)
        if derive and self._external_forces:
            mjw.rne_postconstraint(self._model, self._data)
        if derive:
            self._check_bounds()
        if derive and not self._substep_fields:
            self._derive()

    def _check_bounds(self) -> None:
        """Find diverged worlds and restore their last good state; derived fields are computed afterwards."""
        state = [self._arrays[name] for name in ("qpos", "qvel", "qacc_warmstart", "ctrl", "act")]
        inputs = [*state, self._data.overflow, self._max_velocity]
        results = (self._last_qpos, self._last_qvel, self._diverged, self._counts, self._first, self._overflowed)
        outputs = [wp.from_torch(tensor) for tensor in results]
        wp.launch(warp_kernels.check_bounds, self.num_envs, inputs, outputs, device=self._device)

    def _forward(self, selection: Selection) -> None:
        if not self._substep_fields and (FORCE not in self._derived or not self.forces_after_reset):
            with self._launching():
                self._derive()
            return
        before = self._substep_values()
        with self._launching():
            self._update_velocities()
            mjw.forward(self._model, self._data)
        # the computation covers all worlds: restore those that are not selected
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

    def _capture(self, nstep: int, derive: bool) -> Any:
        stream = wp.Stream(self._device)  # torch's default stream cannot be captured
        with wp.ScopedStream(stream), wp.ScopedCapture(stream=stream, force_module_load=False) as capture:
            self._advance(nstep, derive)
        return capture.graph
