"""Entry point of the plugin (`rlcli.formats`): how rlcli recognises and reads tasks of OmniIsaacGymEnvs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.formats import FormatSpec, Translation

if TYPE_CHECKING:
    from rlcli.config.strict_yaml import Document
    from rlcli.registry import TaskSource

SPEC = FormatSpec(
    summary="tasks of OmniIsaacGymEnvs",
    find="rlcli_oige.format:find",
    read="rlcli_oige.format:read",
    key="oige",
    check="rlcli_oige.format:check",
    open_scene=True,
    environment="rlcli_oige.env:OigeEnv",
    importer="rlcli_oige.command:import_task",
    models="oige.mjcf.{name}",
    aliases={
        "rlcli.oige": "rlcli_oige",
        "gym": "gymnasium",
        "numpy": "rlcli_oige.replacement_modules:find_numpy",
        "hydra": "rlcli_oige.replacement_modules:find_hydra",
        "omegaconf": "rlcli_oige.replacement_modules:find_hydra",
        **dict.fromkeys(
            (
                "omniisaacgymenvs.tasks.base",
                "omniisaacgymenvs.utils.domain_randomization",
                "omniisaacgymenvs.utils.config_utils.sim_config",
                "omniisaacgymenvs",
                "omni",
                "pxr",
                "carb",
                "warp",
            ),
            "rlcli_oige.replacement_modules:find",
        ),
    },
    libraries=("gym", "numpy", "hydra", "omegaconf", "warp"),
)


def find(path: Path) -> TaskSource | None:
    """Return the task of a YAML file, or of a folder with one such file in it or in its `cfg/task`.

    Raises:
        TaskError: if a folder has several, or its Python files have no class of the task.
    """
    from rlcli_oige.task_yaml import task_name

    config = path if path.is_file() else _config(path)
    name = task_name(config) if config is not None else None
    return None if config is None or name is None else _task(config.parent, config, name)


def read(document: Document, source: TaskSource) -> Translation | None:
    """Return a YAML document of OmniIsaacGymEnvs as the data of a task; None for another document."""
    from rlcli_oige.hydra_defaults import compose
    from rlcli_oige.task_yaml import agent_file, is_oige, translate

    document = compose(document, source.config, source.label)
    if not is_oige(document.data):
        return None
    return translate(
        document,
        source.label,
        class_file=source.task_file,
        class_name=source.task.rpartition(":")[2] if source.task else None,
        agent_file=agent_file(source.config),
    )


def check(block: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], str, str]]:
    """Yield (key, message, hint) for each key of the block `oige` that is in the wrong place in a task file."""
    from rlcli_oige.task_keys import MOVED_KEYS

    for path, target in MOVED_KEYS.items():
        section, key = map(str, path)
        values = block.get(section)
        if isinstance(values, dict) and values.get(key) is not None:
            yield (section, key), "this key has another name in rlcli", f"write {target} instead"


def _config(folder: Path) -> Path | None:
    """Return the only YAML of a folder, or of its `cfg/task`, that has this format; None if there is none."""
    from rlcli.errors import TaskError, listing
    from rlcli_oige.task_yaml import is_oige_file

    files = sorted(folder.glob("*.yaml")) or sorted(folder.glob("cfg/task/*.yaml"))
    found = [file for file in files if is_oige_file(file)]
    if len(found) > 1:
        names = listing(f"{folder.name}/{file.relative_to(folder)}" for file in found)
        raise TaskError(f"'{folder}' contains several tasks", hint=f"choose one: {names}")
    return found[0] if found else None


def _task(root: Path, config: Path, name: str) -> TaskSource:
    """Return the location of a task of OmniIsaacGymEnvs: its YAML, and the file and name of its class.

    Args:
        root: folder of the YAML.
        config: the YAML.
        name: name of the task.

    Raises:
        TaskError: if no class of the task is found in the Python files, or several.
    """
    from rlcli.errors import TaskError
    from rlcli.registry import TaskSource
    from rlcli_oige.task_class import find_class
    from rlcli_oige.task_yaml import home

    file: Path | None
    try:
        file, class_name = find_class(home(config), name)
    except LookupError as problem:
        if next(home(config).rglob("*.py"), None) is not None:
            raise TaskError(f"'{config}' is not a task of OmniIsaacGymEnvs: {problem.args[0]}") from None
        file, class_name = None, f"{name}Task"  # the YAML can be checked without the class
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
