"""Safe import of plugins: errors name the plugin, output goes to stderr, and changed settings are restored."""

import builtins
import contextlib
import importlib
import logging
import operator
import os
import re
import reprlib
import sys
import traceback
from collections.abc import Callable, Iterator
from importlib import metadata
from typing import Any, TypeVar

from rlcli.errors import DependencyError, RlcliError, TaskError, listing, pip_install, short_error
from rlcli.formats import FormatSpec
from rlcli.machine.native_output import descriptor_redirected
from rlcli.progress import track
from rlcli.registry.entries import Entry
from rlcli.task import API_VERSION, TaskSpec
from rlcli.trainers import TrainerSpec

_log = logging.getLogger(__name__)
_Spec = TypeVar("_Spec", TaskSpec, TrainerSpec, FormatSpec)


class PluginError(TaskError):
    """Error in the code of a plugin."""


def load_spec(entry: Entry, kind: type[_Spec], what: str) -> _Spec:
    """Import the object of a plugin's entry point, its `TaskSpec`, `TrainerSpec` or `FormatSpec`.

    Args:
        entry: the entry point.
        kind: the class of the object.
        what: task, trainer or format, for messages.

    Raises:
        TaskError: if the plugin is broken, or needs a newer plugin interface.
    """
    spec: _Spec = load_entry(entry, kind)
    if spec.api > API_VERSION:
        raise TaskError(
            f"{what} '{entry.qualified}' ({entry.version}) needs plugin API {spec.api}; this rlcli has {API_VERSION}",
            hint=f"install a newer rlcli: {pip_install('--upgrade rlcli')}",
        )
    return spec


def load_entry(entry: Entry, kind: type) -> Any:
    """Import the object that an entry point names, and check that it is of type `kind`.

    Raises:
        TaskError: for any error of the plugin, with the name of its distribution.
        DependencyError: raised by the plugin itself, passed on.
    """
    with _plugin_named(entry, "cannot be imported", DependencyError):
        value = import_object(entry.value)
    if not isinstance(value, kind):
        raise TaskError(
            f"plugin {entry.distribution} {entry.version}: entry point '{entry.name}' = {entry.value} is a"
            f" {type(value).__name__}, expected a {kind.__name__}; report this to the plugin's authors"
        )
    return value


def call_entry(entry: Entry, *arguments: Any) -> Any:
    """Import the function that an entry names, and call it. A generator is read to its end.

    Raises:
        PluginError: for any error of the plugin, with the name of its distribution.
        RlcliError: raised by the plugin itself, passed on.
    """
    function = load_entry(entry, object)
    with _plugin_named(entry, "failed", RlcliError), contain_side_effects():
        value = function(*arguments)
        return list(value) if isinstance(value, Iterator) else value


def wrong_result(entry: Entry, what: str, value: object, expected: str) -> PluginError:
    """Return the error for a plugin's function that has returned a value of a wrong type.

    Args:
        entry: the plugin's entry point.
        what: name of the function, for the message.
        value: the returned value.
        expected: the allowed values, in words.
    """
    plugin = f"plugin {entry.distribution} {entry.version}"
    return PluginError(
        f"{plugin}: {what} returned a {type(value).__name__}, {reprlib.repr(value)}; expected {expected}",
        hint=f"update or uninstall {entry.distribution}; report this to the authors of the plugin",
    )


@contextlib.contextmanager
def _plugin_named(entry: Entry, failure: str, passed_on: type[RlcliError]) -> Iterator[None]:
    """Convert errors of the `with` block, which runs a plugin's code, to errors that name the plugin.

    Args:
        entry: the plugin's entry point.
        failure: what has failed, for the message: `cannot be imported` or `failed`.
        passed_on: class of errors that are raised unchanged, as KeyboardInterrupt is.

    Raises:
        PluginError: for any other error.
    """
    plugin = f"plugin {entry.distribution} {entry.version}: "
    try:
        with track(f"plugin {entry.qualified} ({entry.value})"):
            yield
    except (passed_on, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise PluginError(
            f"{plugin}entry point '{entry.name}' = {entry.value} {failure}:"
            f" {short_error(error)}{error_location(error)}",
            hint=_newer_rlcli(entry)
            or f"update or uninstall {entry.distribution}; as its author, correct its code or its entry point in"
            " pyproject.toml, and install it again",
        ) from error


def import_object(reference: str) -> Any:
    """Import and return the object of a reference `package.module:Name`. The output of the import goes to stderr."""
    name, _, attributes = reference.rpartition(":")
    if not name:
        raise ValueError("the reference names no object of a module; write MODULE:OBJECT")
    with contain_side_effects():
        module = importlib.import_module(name)
    return operator.attrgetter(attributes)(module)


@contextlib.contextmanager
def contain_side_effects() -> Iterator[None]:
    """Redirect the output of the `with` block to stderr, also that of C code, and restore the current folder.

    Two more kinds of changes are undone, with a warning: torch's default dtype, default device and gradient mode, on
    which rlcli's own tensors depend; and built-in functions that were deleted or replaced by a value.
    """
    built_in = _BUILT_IN.copy()
    settings = _torch_settings() or _TORCH_DEFAULTS
    with contextlib.suppress(OSError, ValueError):  # stdout is closed
        if sys.__stdout__ is not None:
            sys.__stdout__.flush()
    with contextlib.redirect_stdout(sys.stderr), descriptor_redirected(1, 2), current_folder_kept():
        try:
            yield
        finally:
            _restore_built_in(built_in)
            changed = _torch_settings() or settings
            if changed != settings:
                _restore_torch(settings, changed)


@contextlib.contextmanager
def current_folder_kept() -> Iterator[None]:
    """Undo changes of the current folder after the `with` block: the user's relative paths depend on it."""
    folder = _current_folder()
    try:
        yield
    finally:
        if folder is not None and _current_folder() != folder:
            os.chdir(folder)


_BUILT_IN = builtins.__dict__


def _restore_built_in(before: dict[str, Any], is_callable: Callable[[object], bool] = callable) -> None:
    """Restore the built-in functions that a plugin deleted or replaced by a value that cannot be called.

    Until the functions are restored, this function must not call a built-in function by name: `is_callable` is an
    argument for this reason.

    Args:
        before: name -> object of the module `builtins` before the plugin's code ran.
        is_callable: the built-in `callable`.
    """
    lost = [name for name in before if is_callable(before[name]) and not is_callable(_BUILT_IN.get(name))]
    if lost:
        _BUILT_IN.update(before)
        names = listing(lost, limit=3)
        _log.warning("imported code has deleted or replaced the built-in functions %s; rlcli has restored them", names)


_TorchSettings = tuple[str, str, bool]
"""torch's default dtype, its default device, and whether it records gradients (its gradient mode)."""
_TORCH_DEFAULTS: _TorchSettings = ("torch.float32", "cpu", True)
"""Values that these settings of torch have after its import."""


def _torch_settings() -> _TorchSettings | None:
    """Return the present settings of torch; None if torch is not imported."""
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(torch, "get_default_device"):  # the import of torch may have failed
        return None
    return str(torch.get_default_dtype()), str(torch.get_default_device()), torch.is_grad_enabled()


def _restore_torch(before: _TorchSettings, changed: _TorchSettings) -> None:
    """Set the settings of torch to `before`, and warn which of them imported code had changed."""
    import torch

    dtype, device, records = before
    torch.set_default_dtype(getattr(torch, dtype.removeprefix("torch.")))
    torch.set_default_device(None if device == "cpu" else device)
    torch.set_grad_enabled(records)
    rows = zip(("default dtype", "default device", "gradient mode"), before, changed, strict=True)
    changes = " and ".join(f"{name} from {old} to {new}" for name, old, new in rows if old != new)
    _log.warning("imported code has changed torch's %s; rlcli has restored the earlier value", changes)


def error_location(error: BaseException) -> str:
    """Return ` (file:line)` of the code that raised an error; empty if the message has it already (SyntaxError)."""
    # its function `exit_refused` raises errors itself
    own = (__file__, os.path.join(os.path.dirname(__file__), "task_code_monitor.py"))
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename not in own]
    if isinstance(error, SyntaxError) or not frames or frames[-1].filename.startswith("<frozen"):
        return ""
    return f" ({frames[-1].filename}:{frames[-1].lineno})"


def _newer_rlcli(entry: Entry) -> str | None:
    """Return the hint to upgrade rlcli, for a plugin whose metadata requires a newer one; None for other plugins."""
    import rlcli

    requirements: list[str] = []
    with contextlib.suppress(Exception):  # malformed metadata
        requirements = metadata.requires(entry.distribution) or []
    for line in requirements:
        wanted = re.match(r"rlcli\s*(?:\[[^]]*\])?\s*\(?(?:>=|==|~=|>)\s*([0-9]+(?:\.[0-9]+)*)", line)
        if wanted and release_numbers(wanted[1]) > release_numbers(rlcli.__version__):
            found = f"the plugin needs rlcli {wanted[1]}, but {rlcli.__version__} is installed"
            return f"{found}: {pip_install('--upgrade rlcli')}"
    return None


def release_numbers(version: str) -> list[int]:
    """Return the numbers of a version, to compare versions: `2.13.0+cpu` -> [2, 13, 0]."""
    return [int(number) for number in re.findall(r"[0-9]+", version.partition("+")[0])]


def _current_folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # the folder was removed
        return None
