"""Tasks and trainers by name, from the metadata of installed distributions; a plugin is imported only when it is used.

Distributions are read one by one, so that a broken one costs its own row and nothing else.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from rlcli.config.settings import setting, settings_file
from rlcli.errors import DependencyError, MissingModelError, TaskError, did_you_mean, listing
from rlcli.task import API_VERSION, TaskSpec

TASKS = "rlcli.tasks"
TRAINERS = "rlcli.trainers"
OWN = "rlcli"
MODELS = "RLCLI_MODELS"
"""Environment variable: folders in which the user keeps models of robots, as PATH lists its folders."""
"""The distribution of the built-in tasks and trainers; a plugin cannot take their names."""

_entry_points: Any = vars(metadata.Distribution)["entry_points"].fget
"""As the standard library reads them, malformed or not, inside `malformed_metadata_ignored` too."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry point: what can be known of it without importing anything."""

    name: str
    value: str
    distribution: str
    version: str

    @property
    def qualified(self) -> str:
        """`distribution:name`, unique even where two distributions share a name."""
        return f"{self.distribution}:{self.name}"


@dataclass(frozen=True, slots=True)
class Broken:
    """A distribution whose metadata cannot be read."""

    distribution: str
    reason: str


@dataclass(frozen=True, slots=True)
class TaskSource:
    """A task that was found: its name, its files, and what imports its code."""

    name: str
    root: Path
    config: Path
    distribution: str | None
    version: str | None
    term_files: tuple[Path, ...]
    term_modules: tuple[str, ...]
    task: str | None
    task_file: Path | None
    python: str | None = None
    """`module:attribute`, `file.py:attribute` or a package's folder that holds the configuration, if Python does."""
    agents: tuple[tuple[str, str], ...] = ()
    """Further agents of a configuration in Python: (name, `module:attribute`)."""
    value: Any = None
    """The configuration itself, where it exists in memory only."""
    policy: Path | None = None
    """The folder of the policy that is shipped with the task; None: none is."""

    @property
    def label(self) -> str:
        """How messages name the file."""
        try:
            return str(self.config.relative_to(Path.cwd()))
        except ValueError:
            return str(self.config)

    def record(self) -> dict[str, str | None]:
        """What a run stores to find the task again."""
        folder = None if self.distribution else str(self.root)
        record = {
            "name": self.name,
            "distribution": self.distribution,
            "version": self.version,
            "folder": folder,
        }
        return record | ({"python": self.python} if self.python and folder else {})


def catalog(group: str = TASKS, *, hidden: bool = False) -> tuple[list[Entry], list[Broken]]:
    """Every entry of a group, sorted by name then distribution, and the distributions that could not be read.

    Those that RLCLI_PLUGINS or the user's settings leave out are only there if `hidden`.
    """
    entries: dict[tuple[str, str], Entry] = {}
    broken: dict[str, Broken] = {}
    wanted = None if hidden else _wanted()
    for distribution in metadata.distributions():
        folder = Path(str(getattr(distribution, "_path", "?"))).name
        try:
            text = distribution.read_text("entry_points.txt") or ""
            if group not in text:
                continue  # most distributions; their metadata is not read
            name, version = distribution.metadata["Name"], distribution.version
            if not name or not version:
                raise ValueError("no Name and Version in its METADATA")
            if wanted is not None and _normal(name) not in wanted:
                continue
            for point in _entry_points(distribution):
                if point.group == group:
                    entries.setdefault((point.name, _normal(name)), Entry(point.name, point.value, name, version))
        except Exception as error:
            broken.setdefault(folder, Broken(folder, f"malformed metadata ({type(error).__name__}: {error})"))
    return sorted(entries.values(), key=lambda e: (e.name, e.distribution)), list(broken.values())


def unreadable_distributions() -> list[Broken]:
    """Every installed distribution whose metadata is malformed, whether it has to do with rlcli or not."""
    found: dict[str, Broken] = {}
    for distribution in metadata.distributions():
        folder = Path(str(getattr(distribution, "_path", "?")))
        try:
            _entry_points(distribution)
            if not distribution.metadata["Name"] or not distribution.version:
                raise ValueError("no Name and Version in its METADATA")
        except Exception as error:
            reason = f"malformed metadata ({type(error).__name__}: {error}) in {folder}"
            found.setdefault(folder.name, Broken(folder.name, reason))
    return list(found.values())


def unknown_wanted() -> list[str]:
    """Names of plugins to use, of the variable or the user's settings, that have no tasks or trainers here."""
    wanted = _wanted()
    if not wanted:
        return []
    installed = {_normal(entry.distribution) for group in (TASKS, TRAINERS) for entry in catalog(group, hidden=True)[0]}
    return sorted(wanted - installed - {OWN})


def plugins_chosen_by() -> str:
    """What says which plugins to use: the variable, or the user's settings."""
    return "RLCLI_PLUGINS" if os.environ.get("RLCLI_PLUGINS", "").strip() else f"plugins in {settings_file()}"


@contextlib.contextmanager
def malformed_metadata_ignored() -> Iterator[None]:
    """Malformed metadata of an installed package stops nobody who reads the entry points of all packages.

    torch does when it is imported, TensorBoard too; without this one bad file of a stranger ends every command.
    `catalog` says which distribution it is.
    """
    before = vars(metadata.Distribution)["entry_points"]

    def readable(distribution: metadata.Distribution) -> Any:
        try:
            return _entry_points(distribution)
        except Exception:
            return metadata.EntryPoints()

    setattr(metadata.Distribution, "entry_points", property(readable))  # noqa: B010 - a property, to a type checker
    try:
        yield
    finally:
        setattr(metadata.Distribution, "entry_points", before)  # noqa: B010


def find_task(name: str) -> TaskSource:
    """A task by name, by `distribution:name`, by the path of its folder, or, in Python, as `file.py:attribute`.

    A name is looked up among the installed tasks first: a folder of the same name needs a slash, `./cartpole`.

    Raises:
        TaskError: unknown, ambiguous, broken, or built for a newer rlcli.
    """
    place, _, attribute = name.rpartition(":")
    if place.endswith(".py") or (attribute and os.sep not in attribute and "/" in place and Path(place).is_dir()):
        return python_task(name)
    if name in (".", "..") or any(mark in name for mark in ("/", os.sep)):
        from rlcli.config import oige

        path = Path(name)
        if path.suffix == ".yaml" and path.is_file() and oige.is_oige_file(path):
            return folder_task(path.parent, path.name)
        return folder_task(path)
    try:
        entry = find_entry(TASKS, name, what="task")
    except TaskError:
        if name and (Path(name) / "task.yaml").is_file() and not _offered(name):
            return folder_task(Path(name))
        if "=" in name:
            raise TaskError(f"no task '{name}'", hint="overrides come after the task: TASK key.path=value") from None
        raise
    return installed_task(entry)


def installed_task(entry: Entry) -> TaskSource:
    """The task of an entry point, imported as far as its `TaskSpec`.

    Raises:
        TaskError: broken, or built for a newer rlcli.
    """
    spec = load_entry(entry, TaskSpec)
    if spec.api > API_VERSION:
        raise TaskError(
            f"task '{entry.qualified}' ({entry.version}) needs plugin API {spec.api}; this rlcli has {API_VERSION}",
            hint="pip install --upgrade rlcli",
        )
    return packaged_task(entry, spec)


def task_of_file(file: Path) -> TaskSource | None:
    """The installed task that a YAML file belongs to; only plugins whose package holds the file are imported."""
    for entry in catalog()[0]:
        package = package_folder(entry)
        if package is not None and file.resolve().is_relative_to(package.resolve()):
            try:
                source = installed_task(entry)
            except TaskError:
                continue
            if source.config.resolve() == file.resolve():
                return source
    return None


def package_folder(entry: Entry) -> Path | None:
    """Where the top-level package of an entry point lies, without importing it."""
    try:
        found = importlib.util.find_spec(entry.value.partition(":")[0].partition(".")[0])
    except (ImportError, ValueError):
        return None
    places = list(found.submodule_search_locations or ()) if found else []
    return Path(places[0]) if places else None


def is_offered(module: str, source: TaskSource) -> bool:
    """Whether a configuration may name a module: one of a task's own package, or of an installed plugin's.

    Nothing is imported: a configuration is data, and may be a stranger's.
    """
    top = module.partition(".")[0]
    if not top.isidentifier():
        return False
    entries = [entry for group in (TASKS, TRAINERS) for entry in catalog(group)[0]]
    if top in {entry.value.partition(":")[0].partition(".")[0] for entry in entries}:
        return True
    try:
        found = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return False
    places = [Path(place).resolve() for place in (found.submodule_search_locations or ())] if found else []
    return any(source.root.resolve().is_relative_to(place) for place in places)


def packaged_task(entry: Entry, spec: TaskSpec) -> TaskSource:
    """The files of a task in an installed package."""
    root = _folder(spec.package, entry)
    in_python = ":" in spec.config
    config = _module_file(spec.config.partition(":")[0], entry) if in_python else root / spec.config
    if not config.is_file():
        raise TaskError(f"task '{entry.qualified}' is broken: {config} does not exist")
    task_module = spec.task.partition(":")[0] if spec.task else None
    policy = root / spec.policies / entry.name
    return TaskSource(
        name=entry.name,
        root=root,
        config=config,
        distribution=entry.distribution,
        version=entry.version,
        term_files=tuple(_module_file(module, entry) for module in spec.terms),
        term_modules=spec.terms,
        task=spec.task,
        task_file=_module_file(task_module, entry) if task_module else None,
        python=spec.config if in_python else None,
        agents=tuple(spec.agents.items()),
        policy=policy if (policy / "manifest.json").is_file() else None,
    )


def python_task(reference: str, name: str | None = None) -> TaskSource:
    """A task whose configuration is a Python object: `file.py:attribute`, or a package's `folder` or `folder:ID`.

    Of a package the configuration is the `TASK` of its `task.py`, or what it registered with gymnasium (as `ID`).

    Raises:
        TaskError: if there is no such file.
    """
    path, attribute = python_place(reference)
    if path.is_dir():
        file, label = path / "__init__.py", attribute or path.name
    else:
        file, label = path, path.stem
    if not file.is_file():
        raise TaskError(f"there is no file '{file}'")
    if file == path and not attribute:
        raise TaskError(f"'{reference}' does not say which object", hint=f"{reference}:TASK, for example")
    return TaskSource(
        name=name or re.sub(r"[^A-Za-z0-9_.-]", "-", label),
        root=file.parent,
        config=file,
        distribution=None,
        version=None,
        term_files=(),
        term_modules=(),
        task=None,
        task_file=None,
        python=f"{path}:{attribute}" if attribute else str(path),
    )


def python_place(reference: str) -> tuple[Path, str]:
    """The file or folder of a configuration in Python, links resolved, and the name in it ('' if it has none)."""
    place, _, attribute = reference.rpartition(":")
    if not place or Path(reference).exists():
        return Path(reference).resolve(), ""
    return Path(place).resolve(), attribute


def folder_task(folder: Path, file: str = "task.yaml") -> TaskSource:
    """A folder with a `task.yaml`, and optionally `terms.py` and `task.py` (a class `Task`).

    Or with a YAML in the form of OmniIsaacGymEnvs, whatever its name, and the Python file of the task's class. Without
    either the configuration is in Python: `TASK` in `task.py`, or what the package registers.
    """
    root = folder.resolve()
    config = root / file
    if (root / "run.json").exists():
        raise TaskError(f"'{folder}' is a run, not a task", hint=f"--checkpoint {folder}")
    if file == "task.yaml" and root.is_dir() and not config.is_file():
        config = _oige_config(root) or config
    if root.is_file():
        raise TaskError(f"'{folder}' is a file, not a task's folder", hint=f"did you mean '{folder.parent}'?")
    if not config.is_file() and file == "task.yaml":
        if _defines(root / "task.py", "TASK"):
            return python_task(f"{root / 'task.py'}:TASK", root.name)
        if (root / "__init__.py").is_file() and b"register(" in (root / "__init__.py").read_bytes():
            return python_task(str(root))
        classes = _environments(root)
        if len(classes) > 1:
            names = listing(f"{root.name}/{found}" for found in classes)
            raise TaskError(f"'{root}' holds several tasks", hint=f"name one: {names}")
        if classes:
            return python_task(f"{root / classes[0]}", root.name)
    if not config.is_file():
        found = listing(sorted(p.name for p in root.iterdir())) if root.is_dir() else "no such folder"
        raise TaskError(f"'{folder}' is not a task: it has no {file} ({found})")
    from rlcli.config import oige

    name = oige.task_name(config)
    if name is not None:
        return _oige_task(config.parent, config, name)
    terms, task = root / "terms.py", root / "task.py"
    return TaskSource(
        name=root.name,
        root=root,
        config=config,
        distribution=None,
        version=None,
        term_files=(terms,) if terms.is_file() else (),
        term_modules=(str(terms),) if terms.is_file() else (),
        task=f"{task}:Task" if task.is_file() else None,
        task_file=task if task.is_file() else None,
    )


def _oige_config(root: Path) -> Path | None:
    """The one YAML of a folder, or of its `cfg/task`, that has OmniIsaacGymEnvs' form; None if there is none."""
    from rlcli.config import oige

    files = sorted(root.glob("*.yaml")) or sorted(root.glob("cfg/task/*.yaml"))
    found = [file for file in files if oige.is_oige_file(file)]
    if len(found) > 1:
        names = listing(f"{root.name}/{file.relative_to(root)}" for file in found)
        raise TaskError(f"'{root}' holds several tasks", hint=f"name one file: {names}")
    return found[0] if found else None


def _oige_task(root: Path, config: Path, name: str) -> TaskSource:
    from rlcli.config import oige

    file: Path | None
    try:
        file, class_name = oige.find_class(oige.home(config), name)
    except LookupError as problem:
        if next(oige.home(config).rglob("*.py"), None) is not None:
            raise TaskError(f"'{config}' is not a task: {problem.args[0]}") from None
        file, class_name = None, f"{name}Task"  # the YAML can be checked without
    return TaskSource(
        name=root.name if config.name == "task.yaml" else config.stem,
        root=root,
        config=config,
        distribution=None,
        version=None,
        term_files=(),
        term_modules=(),
        task=f"{file or root / 'task.py'}:{class_name}",
        task_file=file,
    )


def find_entry(group: str, name: str, *, what: str) -> Entry:
    """One entry of a group by its name or `distribution:name`."""
    entries, _ = catalog(group)
    matches = [e for e in entries if name in (e.name, e.qualified)]
    own = [e for e in matches if e.distribution == OWN]
    if len(matches) == 1 or own:
        return (own or matches)[0]
    if matches:
        owners = " and ".join(f"{e.distribution} {e.version}" for e in matches)
        choices = " or ".join(e.qualified for e in matches)
        raise TaskError(f"{what} '{name}' is offered by {owners}", hint=f"name one: {choices}")
    if any(name in (e.name, e.qualified) for e in catalog(group, hidden=True)[0]):
        value = os.environ.get("RLCLI_PLUGINS", "").strip()
        said = f"RLCLI_PLUGINS={value}" if value else plugins_chosen_by()
        remedy = "unset RLCLI_PLUGINS" if value else "name its distribution there, or remove that key"
        raise TaskError(f"{what} '{name}' is installed, but {said} leaves its plugin out", hint=remedy)
    names = list(dict.fromkeys(e.name for e in entries))
    installed = listing(sorted({f"{e.distribution} {e.version}" for e in entries}))
    near = did_you_mean(name, [*names, *(e.qualified for e in entries)] if ":" in name else names)
    where = f"installed: {listing(names)} (from {installed})"
    raise TaskError(f"no {what} '{name}'", hint=f"{near} {where}" if near else where)


def load_entry(entry: Entry, kind: type) -> Any:
    """Import what an entry point names; whatever the plugin raises is said with its owner."""
    try:
        value = load_object(entry.value)
    except DependencyError:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise TaskError(
            f"plugin {entry.distribution} {entry.version} is broken: '{entry.name}' = {entry.value}:"
            f" {said}{_place(error)}",
            hint=_newer_rlcli(entry),
        ) from error
    if not isinstance(value, kind):
        raise TaskError(
            f"plugin {entry.distribution} {entry.version} is broken: '{entry.name}' = {entry.value} is a"
            f" {type(value).__name__}, not a {kind.__name__}"
        )
    return value


def _newer_rlcli(entry: Entry) -> str | None:
    """What to do about a plugin that asks for a newer rlcli in its metadata."""
    import rlcli

    requirements: list[str] = []
    with contextlib.suppress(Exception):  # malformed metadata
        requirements = metadata.requires(entry.distribution) or []
    for line in requirements:
        wanted = re.match(r"rlcli\s*(?:\[[^]]*\])?\s*\(?(?:>=|==|~=|>)\s*([0-9]+(?:\.[0-9]+)*)", line)
        if wanted and _numbers(wanted[1]) > _numbers(rlcli.__version__):
            return f"it asks for rlcli {wanted[1]}, this is {rlcli.__version__}: pip install --upgrade rlcli"
    return None


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"[0-9]+", version)]


def load_object(reference: str) -> Any:
    """`package.module:Name` or `/path/file.py:Name` -> the object."""
    module_name, _, attribute = reference.rpartition(":")
    value: Any = load_module(module_name)
    for part in attribute.split("."):
        value = getattr(value, part)
    return value


def load_module(name: str) -> Any:
    """Import a module by its dotted name, or a file of a task folder by its path. Its prints go to stderr."""
    with _contained():
        if not name.endswith(".py"):
            return importlib.import_module(name)
        file = Path(name)
        digest = hashlib.blake2b(str(file.resolve()).encode(), digest_size=8).hexdigest()
        alias = f"rlcli_folder_task_{digest}_{file.stem}"
        if alias not in sys.modules:
            spec = importlib.util.spec_from_file_location(alias, file)
            if spec is None or spec.loader is None:
                raise ImportError(f"cannot import {file}")
            module = importlib.util.module_from_spec(spec)
            sys.modules[alias] = module
            try:
                with _neighbours(file.resolve().parent):
                    spec.loader.exec_module(module)
            except BaseException:
                del sys.modules[alias]
                raise
        return sys.modules[alias]


@contextlib.contextmanager
def _neighbours(folder: Path) -> Iterator[None]:
    """A file of a task folder may import the files beside it, which two tasks may call the same."""
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            place = getattr(sys.modules[name], "__file__", None)
            if place and Path(place).is_relative_to(folder) and not name.startswith("rlcli_folder_task_"):
                del sys.modules[name]


def model_file(root: Path, model: str) -> Path:
    """Where a task in `root` finds a model.

    In its own folder; as `TASK:FILE` in that of an installed task; as `package:PACKAGE/FILE` in an installed package,
    which is not imported; as `models:FILE` in a folder that the environment variable RLCLI_MODELS names. Of several
    with ` | ` between them it is the first that is there.

    Raises:
        MissingModelError: if a model that the user is to have is nowhere.
        TaskError: if there is no such task or package, or the file is not in its folder.
    """
    return _model_file(root, chosen_model(root, model))


def chosen_model(root: Path, model: str) -> str:
    """Of alternatives with ` | ` between them the first that is there; a single one as it is.

    Raises:
        MissingModelError: if none is there.
    """
    choices = [choice.strip() for choice in model.split(" | ")]
    if len(choices) == 1:
        return choices[0]
    reasons, hints = [], []
    for choice in choices:
        try:
            if _model_file(root, choice).is_file():
                return choice
            reasons.append(f"no file '{choice}' in {root}")
        except TaskError as error:
            reasons.append(error.message)
            hints.append(_remedy(choice))
    raise MissingModelError(f"the model is not on this machine: {'; '.join(reasons)}", hint=", or ".join(hints) or None)


def _remedy(model: str) -> str:
    """What makes a model available."""
    kind, _, file = model.partition(":")
    if kind == "models":
        return f"set {MODELS} to a folder that holds {file}"
    if kind == "package":
        return f"install the package {file.partition('/')[0]}, which carries it"
    return f"install the task {kind}"


def _model_file(root: Path, model: str) -> Path:
    task, _, file = model.rpartition(":")
    if not task:
        return root / model
    if task == "package":
        return _package_file(file)
    if task == "models":
        return _users_file(file)
    home = installed_task(find_entry(TASKS, task, what="task")).root
    if not (home / file).resolve().is_relative_to(home.resolve()):
        raise TaskError(f"'{file}' lies outside the folder {home} of task '{task}'")
    return home / file


def _users_file(file: str) -> Path:
    """A file in one of the folders that the user keeps models in."""
    named = [Path(place).expanduser() for place in os.environ.get(MODELS, "").split(os.pathsep) if place]
    for place in named:
        if not (place / file).resolve().is_relative_to(place.resolve()):
            raise TaskError(f"'{file}' lies outside the folder {place} of {MODELS}")
        if (place / file).is_file():
            return place / file
    where = f"no file '{file}' in {listing(map(str, named))} of {MODELS}" if named else f"{MODELS} is not set"
    raise MissingModelError(where, hint=_remedy(f"models:{file}"))


def _package_file(model: str) -> Path:
    """A file in a package, by `PACKAGE/FILE`."""
    package, _, file = model.partition("/")
    try:
        found = importlib.util.find_spec(package) if package.isidentifier() else None
    except (ImportError, ValueError):
        found = None
    places = [Path(place) for place in (found.submodule_search_locations or ())] if found else []
    if not places:
        raise TaskError(f"no Python package '{package}' is installed", hint="write package:PACKAGE/FILE")
    place = next((place for place in places if (place / file).is_file()), places[0])
    if not (place / file).resolve().is_relative_to(place.resolve()):
        raise TaskError(f"'{file}' lies outside the package '{package}' in {place}")
    if not (place / file).is_file():
        raise TaskError(f"no file '{file}' in the package '{package}' in {place}")
    return place / file


def import_file(file: Path) -> Any:
    """Import a file as part of the package that its folder is, so that its relative imports work.

    Modules beside a file of no package are importable too, as for a script.
    """
    with _contained():
        top = file.parent
        while (top.parent / "__init__.py").is_file() and (top / "__init__.py").is_file():
            top = top.parent
        name = _package(top)
        inner = file.parent.relative_to(top).parts + (() if file.stem == "__init__" else (file.stem,))
        sys.path.append(str(top))
        try:
            return importlib.import_module(".".join((name, *inner)))
        finally:
            sys.path.remove(str(top))


def _package(folder: Path) -> str:
    """The name under which a folder is a package: its own, unless that is taken."""
    digest = hashlib.blake2b(str(folder).encode(), digest_size=8).hexdigest()
    alias = f"rlcli_folder_{digest}"
    name = alias
    if folder.name.isidentifier():
        known = sys.modules.get(folder.name)
        mine = known is not None and str(folder) in list(getattr(known, "__path__", ()))
        if mine or (known is None and importlib.util.find_spec(folder.name) is None):
            name = folder.name
    if name in sys.modules:
        return name
    start = folder / "__init__.py"
    if start.is_file():
        spec = importlib.util.spec_from_file_location(name, start, submodule_search_locations=[str(folder)])
    else:
        spec = ModuleSpec(name, None, is_package=True)
        spec.submodule_search_locations = [str(folder)]
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    if spec.loader is not None and start.is_file():
        sys.path.append(str(folder))
        try:
            spec.loader.exec_module(module)
        except BaseException:
            for known_name in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
                del sys.modules[known_name]
            raise
        finally:
            sys.path.remove(str(folder))
    return name


def _environments(root: Path) -> list[str]:
    """`file.py:Class` of a folder's environments in Isaac Lab's words, without what a file only builds upon."""
    files = sorted(root.glob("*.py")) if root.is_dir() else []
    classes = [
        (file.name, node.name, {ast.unparse(base).rpartition(".")[2] for base in node.bases})
        for file in files
        for node in _body(file)
        if isinstance(node, ast.ClassDef)
    ]
    kinds, before = {"ManagerBasedRLEnvCfg"}, 0
    while len(kinds) > before:
        before = len(kinds)
        kinds |= {name for _, name, bases in classes if bases & kinds}
    inner = {(file, base) for file, _, bases in classes for base in bases}
    return [
        f"{file}:{name}"
        for file, name, bases in classes
        if bases & kinds and (file, name) not in inner and not name.upper().endswith("_PLAY")
    ]


def _body(file: Path) -> list[ast.stmt]:
    try:
        return ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return []


def _defines(file: Path, name: str) -> bool:
    """Whether a Python file has a top-level assignment or definition of this name."""
    for node in _body(file):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if getattr(node, "name", None) == name or any(isinstance(t, ast.Name) and t.id == name for t in targets):
            return True
    return False


def _wanted() -> set[str] | None:
    """Distributions that RLCLI_PLUGINS or the user's settings allow (`none` leaves the built-ins), or None for all."""
    value = os.environ.get("RLCLI_PLUGINS", "").strip()
    names = value.split(",") if value else setting("plugins")
    if names is None:
        return None
    return {"rlcli", *(_normal(name.strip()) for name in names if name.strip().lower() != "none")}


def _normal(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


def _offered(name: str) -> bool:
    return any(entry.name == name for entry in catalog()[0])


def _folder(package: str, entry: Entry) -> Path:
    found = _find(package, entry)
    if found is None or not found.submodule_search_locations:
        raise TaskError(f"task '{entry.qualified}' is broken: '{package}' is not a package")
    return Path(next(iter(found.submodule_search_locations)))


def _module_file(module: str, entry: Entry) -> Path:
    found = _find(module, entry)
    if found is None or not found.origin:
        raise TaskError(f"task '{entry.qualified}' is broken: there is no module '{module}'")
    return Path(found.origin)


def _find(module: str, entry: Entry) -> ModuleSpec | None:
    """Where a module lies; its parent packages are imported for that."""
    try:
        with _contained():
            return importlib.util.find_spec(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise TaskError(
            f"task '{entry.qualified}' is broken: {type(error).__name__}: {error}{_place(error)}"
        ) from error


def _place(error: BaseException) -> str:
    traceback = error.__traceback__
    last = None
    while traceback is not None:
        last = (traceback.tb_frame.f_code.co_filename, traceback.tb_lineno)
        traceback = traceback.tb_next
    own = isinstance(error, SyntaxError) or last is None or last[0].startswith("<frozen")
    return "" if own or last is None else f" ({last[0]}:{last[1]})"


@contextlib.contextmanager
def _contained() -> Iterator[None]:
    """What a plugin prints while it is imported, from C too, goes to stderr; where it went with chdir is undone."""
    folder = _folder_now()
    with contextlib.redirect_stdout(sys.stderr), _descriptor_to_stderr():
        try:
            yield
        finally:
            if folder is not None and _folder_now() != folder:
                os.chdir(folder)


def _folder_now() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return None


@contextlib.contextmanager
def _descriptor_to_stderr() -> Iterator[None]:
    """For what writes to file descriptor 1 without asking Python."""
    try:
        if sys.__stdout__ is not None:
            sys.__stdout__.flush()
        kept = os.dup(1)
        os.dup2(2, 1)
    except (OSError, ValueError):  # one of them is closed
        yield
        return
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
