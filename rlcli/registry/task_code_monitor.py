"""Monitor of the code of tasks and plugins while a command runs; it reports errors, warnings and calls that hang."""

import contextlib
import functools
import gc
import logging
import os
import sys
import sysconfig
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NoReturn

import rlcli
from rlcli.errors import TaskError, error_text, error_with_type, short_error
from rlcli.registry.entries import FORMATS, OWN, TASKS, TRAINERS, Entry, catalog
from rlcli.registry.formats import is_framework
from rlcli.safe_text import shorten

_log = logging.getLogger(__name__)

SLOW_S = 10.0
"""Time after which a warning names a call of a task's code that has not returned [s]."""
_SAMPLE_S = 1.0
"""Time between two looks at the running code [s]."""
_MOST_TEXT = 200
"""Largest length of a reported warning [characters]; longer warnings are cut."""
_monotonic = time.monotonic  # the thread `_Watch` needs it even if a task deletes or replaces it
_GROUPS = (FORMATS, TRAINERS, TASKS)
"""Groups of the entry points of plugins."""
_ENTRIES = ("rlcli.cli.app", "rlcli.envs.sharding.worker")
"""Modules that start a command or a worker. Frames outside of them belong to the program that called rlcli."""


def error_of_task(error: BaseException) -> TaskError | None:
    """Return a TaskError for an exception from the code of a task or plugin; None for any other exception.

    An OSError or EOFError that rlcli's own code raised is not from a task, even if a plugin called this code: a full
    disk is not the plugin's fault.
    """
    found = [each for each in _frames_of(error) if is_task_code(each[0])]
    if not found or (isinstance(error, OSError | EOFError) and not raised_by_task(error)):
        return None
    frame, line = next((each for each in reversed(found) if not _is_from_string(each[0])), found[-1])
    hint = getattr(error, "hint", None)
    plugin = None if _plugin(frame, (TASKS,)) else _plugin(frame)
    whose = "task's code" if plugin is None else f"code of the plugin {plugin.distribution} {plugin.version}"
    return TaskError(
        f"{_place(frame, line)}: {frame.f_code.co_name}: {short_error(error)}",
        hint=hint if isinstance(hint, str) else f"correct the {whose} at this line; --debug shows the traceback",
    )


def _frames_of(error: BaseException) -> list[tuple[FrameType, int]]:
    """Return the frames of an error's traceback with their lines.

    If no frame runs code of a task, return the frames of the error's cause, and so on.
    """
    seen: set[int] = set()
    frames: list[tuple[FrameType, int]] = []
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        frames = list(traceback.walk_tb(cause.__traceback__))
        if any(is_task_code(frame) for frame, _ in frames):
            break
        cause = cause.__cause__
    return frames


def raised_by_task(error: BaseException) -> bool:
    """Return whether code of a task, or a library that it called, raised an exception."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    own = [frame for frame in frames if is_task_code(frame) or is_framework(_module(frame))]
    return bool(own) and is_task_code(own[-1])


def is_task_code(frame: FrameType) -> bool:
    """Return whether a frame runs code of a task: a file of an installed plugin, or outside of rlcli and libraries.

    Code from a string (`exec`) belongs to the file of the module in whose namespace it runs.
    """
    file = frame.f_globals.get("__file__") if _is_from_string(frame) else frame.f_code.co_filename
    return isinstance(file, str) and is_task_file(file, _module(frame).partition(".")[0])


def _is_from_string(frame: FrameType) -> bool:
    return frame.f_code.co_filename.startswith("<")


def _place(frame: FrameType, line: int | None = None) -> str:
    """Return file and line of a frame that runs code of a task."""
    line = frame.f_lineno if line is None else line
    if _is_from_string(frame):
        return f"{frame.f_globals.get('__file__')}: line {line} of code in a string"
    return f"{frame.f_code.co_filename}:{line}"


def _innermost(frames: Iterable[FrameType]) -> FrameType | None:
    """Return the innermost frame with code of a task, or None; if possible one with a file, not code from a string.

    Args:
        frames: the frames of the running code, the innermost first.
    """
    found = [frame for frame in frames if is_task_code(frame)]
    return next((frame for frame in found if not _is_from_string(frame)), found[0] if found else None)


@functools.cache
def is_task_file(file: str, package: str) -> bool:
    """Return whether a file, a module of the top-level package `package`, is code of a task or plugin."""
    entry = _plugins().get(package)
    if file.startswith("<") or is_framework(package) or (entry is not None and entry.distribution == OWN):
        return False
    return entry is not None or not any(Path(file).is_relative_to(folder) for folder in _libraries())


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", ""))


def _plugin(frame: FrameType, groups: tuple[str, ...] = _GROUPS) -> Entry | None:
    """Return the entry point of the installed plugin whose package has the code of a frame; None for other code.

    Args:
        frame: the frame.
        groups: the groups of entry points to search.
    """
    return _plugins(groups).get(_module(frame).partition(".")[0])


@functools.cache
def _plugins(groups: tuple[str, ...] = _GROUPS) -> dict[str, Entry]:
    """Return the top-level packages of installed plugins, each with one of its entry points."""
    with contextlib.suppress(Exception):  # without readable metadata, installed plugins count as libraries
        return {entry.package: entry for group in groups for entry in catalog(group, hidden=True)[0]}
    return {}


@functools.cache
def _libraries() -> list[Path]:
    """Return the folders of Python, of the installed packages and of rlcli.

    Packages may be in several folders: of a virtual environment, of the system, of the user (`pip install --user`), and
    a folder of `pip install --target`, which is known by the metadata of its packages.
    """
    folders = [path for name, path in sysconfig.get_paths().items() if name.endswith(("lib", "stdlib"))]
    for path in sys.path:
        named = os.path.basename(path) in ("site-packages", "dist-packages")
        if named or (path and any(Path(path).glob("*.dist-info"))):
            folders.append(path)
    return [*map(Path, folders), Path(rlcli.__file__).parent]


@contextlib.contextmanager
def observe_task_code() -> Iterator[None]:
    """Report what the code of tasks and plugins does in the `with` block, each as one warning in rlcli's log.

    The reports are warnings of this code, records of its loggers without a handler, errors in its threads and
    destructors, and calls that have not returned after `SLOW_S`. Each line of code is reported once.
    """
    # an earlier command of this process may have filled these caches
    for function in (warn_once, is_task_file, _plugins):
        function.cache_clear()
    places: set[str] = set()

    def report(place: str, text: str) -> None:
        if place not in places:
            places.add(place)
            warn_once(f"{place}: {shorten(text, _MOST_TEXT)}")

    def on_warning(message: Any, category: type[Warning], filename: str, lineno: int, *_: Any) -> None:
        report(place_in_task(sys._getframe(1)) or f"{filename}:{lineno}", f"{category.__name__}: {error_text(message)}")

    def on_error(other: Callable[[Any], Any]) -> Callable[[Any], None]:
        def hook(found: Any) -> None:
            frames = [each for each in traceback.walk_tb(found.exc_traceback) if is_task_code(each[0])]
            place = _place(*frames[-1]) if frames else place_in_task(sys._getframe(1))
            if found.exc_value is None or place is None or isinstance(found.exc_value, KeyboardInterrupt):
                other(found)
            # SystemExit in a thread only ends this thread
            elif not (isinstance(found.exc_value, SystemExit) and hasattr(found, "thread")):
                report(place, f"error in a thread or destructor: {error_with_type(found.exc_value)}")

        return hook

    hooks: list[tuple[Any, str, Any]] = [
        (warnings, "showwarning", on_warning),
        (logging, "lastResort", _LastResort(report)),
        (threading, "excepthook", on_error(threading.excepthook)),
        (sys, "unraisablehook", on_error(sys.unraisablehook)),
    ]
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in hooks]
    watch = _Watch(threading.get_ident())
    for owner, name, hook in hooks:
        setattr(owner, name, hook)
    watch.start()
    try:
        yield
    finally:
        watch.end()
        for owner, name, hook in before:
            setattr(owner, name, hook)


@functools.cache
def warn_once(text: str) -> None:
    """Log a warning about a task's code, unless this command has logged it already."""
    _log.warning("%s", text)


class _LastResort(logging.Handler):
    """Logging handler of last resort: for records, such as those of a task, whose logger has no handler."""

    def __init__(self, report: Any) -> None:
        super().__init__(logging.WARNING)
        self._report = report

    def emit(self, record: logging.LogRecord) -> None:
        """Report the text of a record, with the file and line that logged it."""
        try:
            text = record.getMessage()
        except Exception as error:  # for example `logging.warning("%d", "x")`
            text = f"a log record whose text cannot be formatted: {type(error).__name__}"
        self._report(f"{record.pathname}:{record.lineno}", text)


def _frames_of_command(frame: FrameType | None) -> Iterator[FrameType]:
    """Yield a frame and its callers, up to the start of the command."""
    while frame is not None and _module(frame) not in _ENTRIES:
        yield frame
        frame = frame.f_back


def place_in_task(frame: FrameType | None) -> str | None:
    """Return `file:line` of the innermost code of a task in a frame or its callers; None if there is no such code."""
    return _innermost_place(_frames_of_command(frame))


def _innermost_place(frames: Iterable[FrameType]) -> str | None:
    inner = _innermost(frames)
    return None if inner is None else _place(inner)


def frames_of_thread(thread: int | None) -> list[FrameType]:
    """Return the frames of a thread, innermost first, up to the start of the command.

    The garbage collector is off meanwhile: Python 3.11 collects inside of `f_back`. If a finaliser then lets the thread
    continue, `f_back` reads freed memory, and the process may crash.

    Args:
        thread: identifier of the thread.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        return list(_frames_of_command(sys._current_frames().get(thread or 0)))
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def exit_refused() -> Iterator[None]:
    """Let `os._exit` and `os.abort` raise an error in the `with` block: a plugin would end the command silently.

    Other processes, such as children that a library forks, still end. In another thread the call still ends the
    command, with a message if the thread runs code of a task. A task that calls `os.fork` itself also gets an error:
    the child would return from the task's code, and continue the command a second time.
    """
    process, thread = os.getpid(), threading.get_ident()

    def refused(name: str, before: Callable[..., NoReturn]) -> Callable[..., NoReturn]:
        def refuse(*status: int) -> NoReturn:
            if os.getpid() != process:
                before(*status)
            call = f"os.{name}({', '.join(map(str, status))})"
            if threading.get_ident() != thread:
                place = place_in_task(sys._getframe(1))
                if place is None:
                    before(*status)
                warn_once(f"{place}: a thread has ended the command with {call}")
                end(TaskError.exit_code)
            raise SystemExit(f"it called {call}")

        return refuse

    def fork_refused(name: str, before: Callable[[], Any]) -> Callable[[], Any]:
        def fork() -> Any:
            frame = sys._getframe(1)
            if frame.f_back is not None and _module(frame) == "pty":
                frame = frame.f_back
            while frame.f_back is not None and _is_from_string(frame) and "__file__" not in frame.f_globals:
                frame = frame.f_back  # `exec(code, {})` runs in a namespace without a file
            if is_task_code(frame):
                raise RuntimeError(f"os.{name} would continue the command in two processes; use subprocess instead")
            return before()

        return fork

    end = os._exit
    owners = [os, sys.modules[os.name]]  # `os` has the functions of the module `posix` or `nt`
    wrappers = {"_exit": refused, "abort": refused, "fork": fork_refused, "forkpty": fork_refused}
    functions = [(owner, name, getattr(owner, name)) for owner in owners for name in wrappers if hasattr(owner, name)]
    for owner, name, before in functions:
        setattr(owner, name, wrappers[name](name, before))
    try:
        yield
    finally:
        for owner, name, before in functions:
            setattr(owner, name, before)


def report_lasting_threads() -> None:
    """Warn of threads of a task that have not ended `SLOW_S` after the command: the process waits for them."""
    end = _monotonic() + SLOW_S
    for thread in threading.enumerate():
        place = _innermost_place(frames_of_thread(thread.ident))
        if place and not thread.daemon and thread is not threading.main_thread():
            thread.join(max(0.0, end - _monotonic()))
            if thread.is_alive():
                warn_once(
                    f"{place}: a thread still runs {SLOW_S:g} s after the end of the command; Ctrl-C ends the process"
                )


class _OwnTime:
    """Clock of the time in which a thread runs or is blocked, without the time in which it waits for a free CPU.

    Where the kernel does not measure this time (not Linux), the clock gives the time since the start.
    """

    def __init__(self, thread: int) -> None:
        self._file = Path(f"/proc/self/task/{thread}/schedstat")
        self._begin, self._waited_s = _monotonic(), self._wait_s()

    def now(self) -> float:
        """Return the time since the start of the clock [s]."""
        return _monotonic() - self._begin - (self._wait_s() - self._waited_s)

    def _wait_s(self) -> float:
        try:
            return int(self._file.read_text().split()[1]) * 1e-9
        except (OSError, ValueError, IndexError):
            return 0.0


class _Watch(threading.Thread):
    """Thread that looks at the running code once a second, and warns of calls of a task's code that do not return.

    Args:
        thread: identifier of the thread to watch, which must create this object.
    """

    def __init__(self, thread: int) -> None:
        super().__init__(name="watch", daemon=True)
        self._watched, self._ended = thread, threading.Event()
        self._clock = _OwnTime(threading.get_native_id())
        self._reported: set[CodeType] = set()

    def end(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()

    def run(self) -> None:
        """Look at the running code until `end` is called."""
        # code of a task may replace modules that this thread needs; the command reports this
        with contextlib.suppress(Exception):
            self._watch()

    def _watch(self) -> None:
        since: dict[FrameType, float] = {}  # the keys keep the frames alive: a new one cannot get the same identity
        while not self._ended.wait(_SAMPLE_S):
            frames = frames_of_thread(self._watched)
            now = self._clock.now()
            since = {frame: since.get(frame, now) for frame in _calls(frames)}
            call = next((frame for frame, begin in since.items() if now - begin >= SLOW_S - _SAMPLE_S), None)
            if call is not None and call.f_code not in self._reported:
                self._reported.add(call.f_code)
                self._warn_of(call, _innermost(frames[: frames.index(call)]) or call)
            frames, call = [], None

    @staticmethod
    def _warn_of(call: FrameType, inner: FrameType) -> None:
        """Warn of a call that does not return; `inner` is the innermost code of the task that runs in it."""
        entry, advice = _plugin(call), ""
        place = f"{_place(call)}: "
        if entry is not None:
            place = f"plugin {entry.distribution} {entry.version}: {place}"
            advice = "; if the call does not end, exclude the plugin with RLCLI_PLUGINS=none"
        at = "" if inner is call else f"; the call is at {_place(inner)}, {inner.f_code.co_name}"
        warn_once(f"{place}{call.f_code.co_name} has not returned for {SLOW_S:g} s{at}{advice}")


def _calls(frames: Iterable[FrameType]) -> Iterator[FrameType]:
    """Yield the frames in which rlcli has called code of a task or plugin, the innermost first.

    Frames of trainers are left out, except for their import: an iteration may take minutes.

    Args:
        frames: the frames of the running code, the innermost first.
    """
    inner: FrameType | None = None
    for frame in (*frames, None):
        plugin = None if frame is None else _plugin(frame)
        if frame is not None and (is_task_code(frame) or (plugin is not None and plugin.distribution != OWN)):
            inner = frame
        elif inner is not None and (frame is None or is_framework(_module(frame))):
            is_trainer = _plugin(inner, (TRAINERS,)) is not None
            if not is_trainer or inner.f_code.co_name == "<module>":
                yield inner
            inner = None
