"""Import of the YAML files that Isaac Lab writes into the folder `params` of a run, as a task of rlcli."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.config.dump import to_yaml
from rlcli.config.load import check_all
from rlcli.errors import ConfigError, Problem, UsageError
from rlcli.formats import Imported, Note
from rlcli.registry import folder_task, model_file
from rlcli_isaaclab.config_class import to_dict
from rlcli_isaaclab.convert import agent, task
from rlcli_isaaclab.dump_yaml import read
from rlcli_isaaclab.envs import ManagerBasedRLEnvCfg
from rlcli_isaaclab.observation_sets import fit_groups
from rlcli_isaaclab.settings import Report


def convert(env: Path, agent_file: Path | None, folder: Path, models: Mapping[str, str]) -> Imported:
    """Write the folder of a task for the files of an Isaac Lab run.

    Args:
        env: env.yaml of the run.
        agent_file: RSL-RL's agent.yaml of the run.
        folder: folder to write.
        models: entity -> MJCF, for entities whose USD file is not in `model_lookup.USD_TO_MJCF`.

    Raises:
        ConfigError: if the files do not describe a valid task; then nothing is written.
        UsageError: if the folder contains a task already.
    """
    if (folder / "task.yaml").exists():
        raise UsageError(f"{folder / 'task.yaml'} exists", hint="choose another folder with -o")
    report, agent_report = Report(), None
    model_files = {name: str(Path(model).resolve()) for name, model in models.items()}
    data: dict[str, Any] = {"summary": f"Imported from {env.name} of Isaac Lab."}
    source = read(env)
    problems: list[Problem] = []
    try:
        data |= task(source, report, Path.cwd(), to_dict(ManagerBasedRLEnvCfg()), model_files)
    except ConfigError as error:
        problems += [Problem(str(env), p.path, p.message, p.hint) for p in error.problems]
    if agent_file is not None:
        agent_report = Report()
        try:
            data["agents"] = {"default": "rsl-rl", "rsl-rl": _agent(agent_file, agent_report, data)}
        except ConfigError as error:
            problems += [Problem(str(agent_file), p.path, p.message, p.hint) for p in error.problems]
    if problems:
        raise ConfigError(problems)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".import-") as parent:
        draft = Path(parent) / folder.name
        draft.mkdir()
        names = _write(draft, data, report)
        check_all(folder_task(draft))
        folder.mkdir(exist_ok=True)
        for name in names:
            shutil.move(draft / name, folder / name)
    notes = report.notes(where=str(env))
    if agent_report is not None:
        notes += agent_report.notes("agent", str(agent_file))
    return Imported(folder, [folder / name for name in names], notes)


def _write(folder: Path, data: dict[str, Any], report: Report) -> list[str]:
    """Write the files of the task, and copy the models that need no other files; return the names of the files."""
    files = ["task.yaml"]
    for entity in data["scene"]["entities"].values():
        model = model_file(Path.cwd(), entity["model"])
        if _compiles_alone(model, folder):
            entity["model"] = model.name
            files += [model.name] if model.name not in files else []
    (folder / "task.yaml").write_text(to_yaml(data), encoding="utf-8")
    if report.stubs:
        (folder / "terms.py").write_text(_stubs(report), encoding="utf-8")
        files.append("terms.py")
    return files


def _compiles_alone(model: Path, folder: Path) -> bool:
    """Copy an MJCF into a folder, and return whether it compiles there; if it does not (lacking meshes), remove it."""
    from rlcli.scene.untrusted_mjcf import read_mjcf

    copy = folder / model.name
    if copy.exists():
        return True
    try:
        shutil.copyfile(model, copy)
        read_mjcf(copy, [folder]).compile()
    except (OSError, ValueError):
        copy.unlink(missing_ok=True)
        return False
    return True


def _stubs(report: Report) -> str:
    """Return a Python module with a stub for each term whose code is not in the imported files."""
    lines = ['"""Terms to write. Their code is not in the imported files."""', ""]
    lines += ["from rlcli.task import Bodies, Entity, Joints"]
    for name, (section, params) in report.stubs.items():
        parameters = "".join(f", {key}: {_annotation(key, value)}" for key, value in params.items())
        star = ", *" if parameters else ""
        to_do = [f'    """To do: write this term of {section}."""', f'    raise NotImplementedError("{name}")']
        if section == "commands":
            lines += ["", "", f"class {name}:", to_do[0], "", f"    def __init__(self, env{star}{parameters}):"]
            lines += [
                "        # self.command is a tensor (num_envs, k); change it only in place",
                f"    {to_do[1]}",
                "",
            ]
            lines += [
                "    def resample(self, selection):",
                '        """Sample new commands: selection.write(self.command, selection.uniform(...))"""',
            ]
            lines += ["", "    def update(self):", '        """Update the command, once per step."""']
            continue
        selection = ", selection" if section in ("events", "curriculum") else ""
        lines += ["", "", f"def {name}(env{selection}{star}{parameters}):", *to_do]
    return "\n".join(lines) + "\n"


def _annotation(key: str, value: Any) -> str:
    alias = {"entity": "Entity", "joints": "Joints", "bodies": "Bodies"}.get(key)
    if alias:
        return alias
    if isinstance(value, bool | int | float | str):
        return type(value).__name__
    if isinstance(value, list) and len({type(item) for item in value} & {int, float}) == 2:
        return "list[float]"
    if isinstance(value, list) and value:
        return f"list[{_annotation('', value[0])}]"
    if isinstance(value, dict) and value:
        return f"dict[str, {_annotation('', next(iter(value.values())))}]"
    return "str | None"


def _agent(file: Path, report: Report, data_of_task: Mapping[str, Any]) -> dict[str, Any]:
    data = read(file)
    if "algorithm" not in data or "num_steps_per_env" not in data:
        hint = "agents of rl_games, skrl and Stable-Baselines3 cannot be imported: write the agent by hand"
        what = "not an agent.yaml of RSL-RL: algorithm or num_steps_per_env is missing"
        raise ConfigError([Problem(str(file), "", what, hint)])
    settings = agent(data, report)
    if data.get("obs_groups"):
        notes: list[Note] = []
        fit_groups(data["obs_groups"], settings, data_of_task.get("observations", {}), notes)
        if notes:
            report.entries[("obs_groups",)] = (notes[0].status, "; ".join(note.text for note in notes))
    return settings
