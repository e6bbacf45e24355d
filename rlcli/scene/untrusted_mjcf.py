"""Read untrusted MJCF, with limits on the files that a model may open and on its memory and compile time.

The text is parsed (`mjcf_safety_check`) before MuJoCo reads it. Files that a model includes or loads must lie in the
folders that its task may read, after links are resolved. The elements that take compile time are counted. Expensive
models of a scene are first compiled together in a subprocess with limits on memory and time; above a second threshold
they are refused. All ordinary robots are below the first threshold and are compiled at once: parsing takes
milliseconds, a subprocess half a second.
"""

from __future__ import annotations

import json
import math
import subprocess
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from rlcli.errors import listing, one_line
from rlcli.machine.memory import memory_error
from rlcli.machine.processes import python_command
from rlcli.registry import chosen_model, model_file
from rlcli.safe_text import shorten
from rlcli.scene.mjcf_cost import ModelCost
from rlcli.scene.mjcf_safety_check import MAX_COST, MAX_MEMORY, BadModel, MjcfScan
from rlcli.sim.quiet_mujoco import quiet_mujoco

SUBPROCESS_COST = 5_000
"""Cost above which a model or the models of a scene are first compiled in a subprocess; unit: one element."""
TIME_S = 10
"""Limit of the CPU time of the subprocess that compiles models [s].

The operating system enforces it. If the subprocess waits for the CPU, it is killed after `_WALL_TIME_S`.
"""
_WALL_TIME_S = 6 * TIME_S
"""Limit of the elapsed time of the subprocess [s]; on a system without limits of the CPU time, it is the only one."""
_MAX_ITERATIONS = 100_000
_MAX_GRAVITY = 10_000
_compiled: set[tuple[object, ...]] = set()
"""Files and their versions of scenes that a subprocess has compiled without an error, and need no second check."""
MUJOCO_ERRORS = (ValueError, RuntimeError, MemoryError, mujoco.FatalError, mujoco.UnexpectedError)
"""Exceptions that MuJoCo raises for a model that it cannot read or compile."""


@dataclass(frozen=True, slots=True)
class CheckedModel:
    """MJCF that `check_mjcf` has checked, and that MuJoCo has not opened yet."""

    file: Path
    cost: ModelCost
    """Estimate of the cost of compiling the model."""
    scan: MjcfScan
    """The check, which knows the model's files."""


def read_mjcf(file: Path, roots: Sequence[Path], *, installed: bool = False, compiled: bool = False) -> mujoco.MjSpec:
    """Check an untrusted MJCF, and return it as an MjSpec.

    Args:
        file: MJCF of the model.
        roots: folders that must contain the model and all files that it loads.
        installed: whether the model belongs to an installed package, whose size is trusted.
        compiled: whether to check by compiling that MuJoCo accepts the model.

    Raises:
        BadModel: if the model is refused, or MuJoCo cannot read it.
    """
    checked = check_mjcf(file, roots, installed=installed)
    together = ModelsTogether()
    together.add(checked)
    together.compile_expensive()
    return open_mjcf(checked, compiled=compiled)


def check_mjcf(file: Path, roots: Sequence[Path], *, installed: bool = False) -> CheckedModel:
    """Check an untrusted MJCF without MuJoCo; the arguments are those of `read_mjcf`.

    Raises:
        BadModel: if the model is refused.
    """
    scan = MjcfScan(file, [root.resolve() for root in roots], limited=not installed)
    if not any(file.resolve().is_relative_to(root) for root in scan.roots):
        raise BadModel(f"{file}: lies outside of {scan.roots[0]}; move the file into this folder")
    return CheckedModel(file, scan.read(), scan)


@dataclass(slots=True)
class ModelsTogether:
    """Check of all models of one scene together: the sum of their costs is limited.

    Models of installed packages are not counted.
    """

    cost: ModelCost = field(default_factory=ModelCost)
    _models: list[CheckedModel] = field(default_factory=list)

    def add(self, model: CheckedModel) -> None:
        """Add the cost of a checked model to the sum; models of installed packages are not counted.

        Raises:
            BadModel: if the models are too large together.
        """
        if not model.scan.limited:
            return
        self._models.append(model)
        self.cost = self.cost.beside(model.cost)
        if self.cost.total > MAX_COST:
            raise BadModel(
                f"{model.file}: the first {len(self._models)} models of the scene are too large together: the estimated"
                f" cost of their compilation is {self.cost.total:,.0f}; at most {MAX_COST:,} is allowed (an ordinary"
                " element costs 1, a mesh or image more); use fewer entities or smaller meshes"
            )

    def compile_expensive(self) -> None:
        """If the models are expensive, compile them as one scene in a subprocess, unless that was done before.

        Raises:
            BadModel: if the models cannot be compiled within the limits of the subprocess.
        """
        files = [model.file for model in self._models]
        versions = (*files, *(version for model in self._models for version in model.scan.versions.items()))
        if self.cost.total > SUBPROCESS_COST and versions not in _compiled:
            _compile_in_subprocess(files)
            _compiled.add(versions)


def open_mjcf(checked: CheckedModel, *, compiled: bool = False) -> mujoco.MjSpec:
    """Return a checked MJCF as an MjSpec.

    Args:
        checked: the model.
        compiled: whether to check by compiling that MuJoCo accepts the model.

    Raises:
        BadModel: if MuJoCo cannot read or compile the model, or the model has an option with which it cannot run.
        MachineError: if memory is too small.
    """
    file = checked.file
    try:
        quiet_mujoco()
        spec = mujoco.MjSpec.from_file(str(file))
        if compiled or spec.compiler.settotalmass > 0:  # `write_masses` compiles the model
            with warnings.catch_warnings():  # a deprecated attribute of the file
                warnings.simplefilter("ignore")
                spec.compile()
    except MUJOCO_ERRORS as error:
        if too_little := memory_error(error):
            raise too_little from None
        message = one_line(error).replace(", line 0", "")  # MuJoCo names line 0 for elements of included files
        raise BadModel(f"{checked.scan.file_of(str(error))}: {message}") from None
    _check_options(spec, file)
    return spec


def model_roots(root: Path, model: str) -> list[Path]:
    """Return the folders from which a model may load files: those of its task or of its package.

    Args:
        root: the task's folder.
        model: the value of `model` in the YAML: a file of the task, or a reference such as `package:FILE`.
    """
    task, _, inner = chosen_model(root, model).rpartition(":")
    if not task:
        return package_roots(root)
    home = model_file(root, model)
    if task == "file":
        return package_roots(home.parent)
    for _ in Path(inner.partition("/")[2] if task == "package" else inner).parts:
        home = home.parent
    return package_roots(home)


def package_roots(root: Path) -> list[Path]:
    """Return a task's folder, and the topmost Python package that contains it."""
    top = root.resolve()
    while (top / "__init__.py").is_file() and (top.parent / "__init__.py").is_file():
        top = top.parent
    return [root, top]


def _check_options(spec: mujoco.MjSpec, file: Path) -> None:
    """Check that a model has no options that MuJoCo accepts but with which no simulation works."""
    option = spec.option
    if not (math.isfinite(option.timestep) and option.timestep > 0):
        raise BadModel(f"{file}: option timestep is {option.timestep:g}; it must be above 0")
    for name in ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations"):
        value = int(getattr(option, name, 0))
        if not 0 <= value <= _MAX_ITERATIONS:
            raise BadModel(f"{file}: option {name} is {value}; it must be between 0 and {_MAX_ITERATIONS:,}")
    for name in ("gravity", "wind", "magnetic", "tolerance", "impratio", "density", "viscosity"):
        if not np.isfinite(getattr(option, name)).all():
            raise BadModel(f"{file}: option {name} is not finite; give finite numbers")
    if np.abs(option.gravity).max() > _MAX_GRAVITY:
        found = " ".join(f"{value:g}" for value in option.gravity)
        raise BadModel(f'{file}: option gravity="{found}" is too large; at most {_MAX_GRAVITY:,} m/s^2 is allowed')
    widths = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    positions = sum(widths.get(joint.type, 1) for joint in spec.joints)
    for key in spec.keys:
        if len(key.qpos) not in (0, positions):
            raise BadModel(f"{file}: keyframe '{key.name}' has {len(key.qpos)} positions; give {positions}")


def _compile_in_subprocess(files: Sequence[Path]) -> None:
    """Compile models as one scene in a subprocess, which the system ends if it exceeds its memory or time.

    Raises:
        BadModel: if compiling fails.
    """
    command = python_command("-c", _SUBPROCESS_CODE, str(MAX_MEMORY), str(TIME_S))
    names = json.dumps([str(file) for file in files])
    try:
        # the subprocess limits its CPU time itself; on a busy machine it takes longer
        done = subprocess.run(
            command, input=names, capture_output=True, text=True, errors="replace", timeout=_WALL_TIME_S
        )
    except subprocess.TimeoutExpired:
        advice = "try again when the machine is less busy, or simplify the model"
        raise BadModel(f"{_named(files)}: compiling takes more than {_WALL_TIME_S} s; {advice}") from None
    if done.returncode == 0:
        return
    limits = f"{TIME_S} s of CPU time or {MAX_MEMORY >> 30} GiB of memory"
    why = done.stdout.strip() or (
        f"{_named(files)}: compiling takes more than {limits}, or crashes (exit code {done.returncode}); simplify the"
        " model"
    )
    raise BadModel(shorten(" ".join(why.split()), 500))


def _named(files: Sequence[Path]) -> str:
    """Return file names as text for a message, each name once, with the number of models if there are several."""
    names = listing(list(dict.fromkeys(map(str, files)))[:5])
    return names if len(files) == 1 else f"{names} ({len(files)} models together)"


_SUBPROCESS_CODE = """
import json, sys
memory, time, files = int(sys.argv[1]), int(sys.argv[2]), json.load(sys.stdin)
import mujoco
from rlcli.scene.name_elements import name_all
log = mujoco.MjLogConfig()
log.logto_file = log.logto_console = False
log.set()
try:
    import resource
    for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, time), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, limit))
except (ImportError, ValueError, OSError):
    pass  # no limits on this system; the timeout of the parent process remains
scene = mujoco.MjSpec()
scene.copy_during_attach = True
try:
    for number, file in enumerate(files):
        child = mujoco.MjSpec.from_file(file)
        name_all(child)  # as the scene does: for many elements it takes as long as reading the file
        if len(files) == 1:
            scene = child
        else:
            for key in list(child.keys):
                child.delete(key)
            scene.attach(child, prefix=f"{number}/", frame=scene.worldbody.add_frame())
    file = ", ".join(list(dict.fromkeys(files))[:5])
    scene.compile()
except Exception as error:
    text = str(error) or type(error).__name__
    if not isinstance(error, MemoryError) and "allocate memory" not in text and "unknown exception" not in text:
        print(f"{file}: {text}")  # the others mean too little memory
    sys.exit(1)
"""
