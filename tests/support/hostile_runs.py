"""Malicious run folders; code that was executed leaves a canary file."""

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

MODEL = """
<mujoco><worldbody><body name="block">
  <joint name="slide" type="slide"/><geom type="box" size="0.3 0.3 0.3" mass="1"/>
</body></worldbody></mujoco>
"""
OIGE = "name: Evil\nphysics_engine: physx\nenv: {numEnvs: 4}\nsim: {dt: 0.01}\n"


def code(canary, rest=""):
    return f"open({str(canary)!r}, 'a').write('ran')\n{rest}"


def evil_task(folder, canary, config):
    """Write a task with malicious code in every Python file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "task.yaml").write_text(config)
    for name in ("task.py", "terms.py", "__init__.py", "evil.py", "mujoco.py", "cartpole.py"):
        rest = "class Task: ...\nTASK = Task\ndef register(): ...\nregister()\ndef mirror(**_): ...\n"
        (folder / name).write_text(code(canary, rest))
    (folder / "model.xml").write_text(MODEL)
    (folder / "cartpole.xml").write_text(MODEL)
    return folder


def edit(run, **entries):
    record = json.loads((run / "run.json").read_text())
    task = entries.pop("task", None)
    record.update(entries)
    if task is not None:
        record["task"] = {"version": None, "distribution": None, "folder": None, "file": "task.yaml", **task}
        record["task"].setdefault("name", "cartpole")
    (run / "run.json").write_text(json.dumps(record))


def rewrite(file, old, new):
    text = file.read_text()
    assert old in text, (file, old)
    file.write_text(text.replace(old, new, 1))


def link(path, target):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)


def pipe(path):
    path.unlink(missing_ok=True)
    os.mkfifo(path)


# --- code execution: name -> function that prepares the attack; `at` has run, evil and cwd ---


def _named(**task):
    return lambda at: edit(at.run, task={key: value.format(**vars(at)) for key, value in task.items()})


def _inside(at):
    shutil.copytree(at.evil, at.run / "task")
    edit(at.run, task={"folder": str(at.run / "task")})


def _run_is_the_task(at):
    shutil.copytree(at.evil, at.run, dirs_exist_ok=True)
    edit(at.run, task={"folder": str(at.run)})


def _linked(at):
    (at.cwd / "harmless").symlink_to(at.evil)
    edit(at.run, task={"folder": "harmless"})


def _oige(at):
    (at.evil / "task.yaml").write_text(OIGE)
    (at.evil / "evil.py").write_text(code(at.canary, "class EvilTask: ...\n"))
    edit(at.run, task={"folder": str(at.evil), "name": "evil"})


def _spelled_like_a_known_one(at):
    """Refer to a file of the run by a path that ends like a trusted folder's path."""
    from rlcli.runs.trusted_tasks import named_task

    known = at.cwd / "known"
    known.mkdir()
    shutil.copy(at.run / "config.yaml", known / "task.yaml")
    named_task(str(known))
    up = "../" * (len(at.run.relative_to(at.cwd).parts) + 1)
    shutil.copy(at.evil / "task.py", at.run / "task.py")
    edit(at.run, task={"folder": str(at.run), "python": f"{at.run}/task.py:x/{up}known"})


CODE = {
    "a folder": _named(folder="{evil}"),
    "a folder of the run": _inside,
    "the run itself": _run_is_the_task,
    "a relative folder": _named(folder="evil"),
    "a folder beside": _named(folder="./evil/../evil"),
    "a folder behind a link": _linked,
    "a folder with a slash at its end": _named(folder="{evil}/"),
    "a YAML of OmniIsaacGymEnvs": _oige,
    "a Python file": _named(folder="{evil}", python="{evil}/task.py:TASK"),
    "a Python file in the current folder": _named(folder=".", python="evil/task.py:TASK"),
    "a package": _named(folder="{evil}", python="{evil}"),
    "a package's task": _named(folder="{evil}", python="{evil}:Evil-v0"),
    "a file spelled like a known folder": _spelled_like_a_known_one,
    "an attribute of an installed module": _named(folder="/", python=f"{os.__file__}:system"),
    "a file as distribution": _named(distribution="{evil}/task.py", name="TASK"),
    "a folder as distribution": _named(distribution="{evil}", name="Evil-v0"),
    "a module as distribution": _named(distribution="evil", name="TASK"),
    "a distribution and a folder": _named(distribution="evil", folder="{evil}", python="{evil}/task.py:TASK"),
    "a null byte": _named(folder="{evil}\0"),
    "a home folder": _named(folder="~/evil"),
}
"""Refused by every command, with exit code 5 or 4."""


# --- malicious configurations ---


def _config(old, new):
    return lambda at: rewrite(at.run / "config.yaml", old, new.format(**vars(at)))


CONFIG = {
    "a term of a module": _config("func: is_alive", "func: evil.register"),
    "a term of a file": _config("func: is_alive", "func: '{evil}/terms.py:register'"),
    "a term with a colon": _config("func: is_alive", "func: 'os:system'"),
    "a model beside the task": _config("model: cartpole.xml", "model: ../../../../../../../..{evil}/model.xml"),
    "a model elsewhere": _config("model: cartpole.xml", "model: '{evil}/model.xml'"),
    "a model of a package that is a folder here": _config("model: cartpole.xml", "model: 'package:evil/model.xml'"),
    "a model of another task's neighbour": _config(
        "model: cartpole.xml", "model: 'cartpole:../../../{evil}/model.xml'"
    ),
    "a trainer of a file": _config("trainer: sb3", "trainer: '{evil}/evil.py:TASK'"),
    "a trainer of a module": _config("trainer: sb3", "trainer: 'evil:TASK'"),
    "an object": _config("trainer: sb3", "trainer: !!python/object/apply:os.system ['touch {canary}']"),
    "a class": _config("trainer: sb3", "trainer: sb3\n    policy_class: evil.TASK"),
    "an override that is code": _config("trainer: sb3", "trainer: sb3\n    learning_rate: __import__('evil')"),
    "a billion environments": lambda at: _everywhere(at.run / "config.yaml", "num_envs: ", "num_envs: 9999999"),
    "threads without end": _config("engine_threads: ", "engine_threads: 100000000 # "),
    "an alias": _config("trainer: sb3", "trainer: &a sb3"),
    "a terminal's commands": _config("trainer: sb3", 'trainer: "\\e]0;owned\\a\\e[2J"'),
    "a pipe": lambda at: pipe(at.run / "config.yaml"),
    "a device": lambda at: link(at.run / "config.yaml", "/dev/zero"),
    "a link to a file of the user": lambda at: link(at.run / "config.yaml", "/etc/passwd"),
    "a hundred megabytes": lambda at: _grow(at.run / "config.yaml"),
    "nothing": lambda at: (at.run / "config.yaml").unlink(),
    "a folder": lambda at: ((at.run / "config.yaml").unlink(), (at.run / "config.yaml").mkdir()),
}
"""Refused by every command that reads the configuration, with exit code 3 or 5."""


def _everywhere(file, old, new):
    file.write_text(file.read_text().replace(old, new))


def _grow(file):
    with file.open("r+b") as opened:
        opened.truncate(100 << 20)


# --- malicious run.json ---


def _record(**entries):
    return lambda at: edit(at.run, **entries)


def _text(text):
    return lambda at: (at.run / "run.json").write_bytes(text if isinstance(text, bytes) else text.encode())


_INSTALLED = '"task": {"name": "cartpole", "distribution": "rlcli"}'
RECORD = {
    "a pipe": lambda at: pipe(at.run / "run.json"),
    "a device": lambda at: link(at.run / "run.json", "/dev/zero"),
    "a terminal": lambda at: link(at.run / "run.json", "/dev/tty"),
    "a link to a file of the user": lambda at: link(at.run / "run.json", "/etc/passwd"),
    "a link to itself": lambda at: link(at.run / "run.json", at.run / "run.json"),
    "a hundred megabytes": lambda at: _grow(at.run / "run.json"),
    "a hundred thousand brackets": _text("[" * 100_000),
    "deep objects": _text('{"a":' * 50_000 + "1" + "}" * 50_000),
    "no text": _text(b"\xff\xfe\x00"),
    "a number of a million digits": _text(f'{{{_INSTALLED}, "seed": 1{"0" * 1_000_000}}}'),
    "a number of 400 digits": _text(f'{{{_INSTALLED}, "seed": 1{"0" * 400}}}'),
    "a seed that is NaN": _text(f'{{{_INSTALLED}, "seed": NaN}}'),
    "an infinite seed": _text(f'{{{_INSTALLED}, "seed": Infinity}}'),
    "a seed below zero": _record(seed=-5),
    "a seed that is true": _record(seed=True),
    "a seed that is text": _record(seed="1"),
    "a list": _text("[1, 2]"),
    "a task that is a list": lambda at: (
        edit(at.run) or rewrite(at.run / "run.json", '"task": {', '"task": [{}], "x": {')
    ),
    "a name that is a path": _record(task={"distribution": "rlcli", "name": "../../evil"}),
    "a name that is the folder above": lambda at: edit(at.run, task={"folder": str(at.evil), "name": ".."}),
    "a name that is a list": _record(task={"distribution": "rlcli", "name": ["cartpole"]}),
    "a name that commands the terminal": _record(task={"distribution": "rlcli", "name": "cart\x1b[2Jpole"}),
    "a distribution that commands the terminal": _record(task={"distribution": "rl\x1b]0;x\x07cli"}),
    "a folder that commands the terminal": _record(task={"folder": "/tmp/\x1b[31mred"}),
    "a version with a line of its own": _record(task={"distribution": "rlcli", "version": "1\nerror: all is well"}),
    "text that runs backwards": _record(task={"distribution": "rlcli", "name": "cart\u202epole"}),
    "a distribution that is a mapping": _record(task={"distribution": {"a": 1}}),
    "a folder that is a number": _record(task={"folder": 7}),
    "loggers that are a number": _record(loggers=7),
    "versions that are a list": _record(versions=[1]),
    "an agent that is a list": _record(agent=[1]),
    "a checkpoint to begin from that is a number": _record(init_from=7),
    "resumes that are a number": _record(resumed=7),
    "a state that is a number": _record(state=1),
    "threads without end": _record(torch_threads=10**9),
    "threads below one": _record(torch_threads=0),
    "threads that are text": _record(torch_threads="four"),
}
"""Refused by every command, with exit code 5."""


# --- links and pipes in the run: commands must not write through them ---


def _linked_file(name, content="victim"):
    def plant(at):
        victim = at.cwd / "victim"
        victim.write_text(content)
        path = at.run / name
        path.parent.mkdir(exist_ok=True)
        link(path, victim)

    return plant


def _linked_folder(name):
    def plant(at):
        shutil.copytree(at.run / name, at.cwd / "victims") if (at.run / name).is_dir() else (at.cwd / "victims").mkdir()
        (at.cwd / "victims" / ".tmp-1").mkdir()
        (at.cwd / "victims" / ".tmp-1" / "kept").touch()
        link(at.run / name, at.cwd / "victims")

    return plant


def _piped(name):
    def plant(at):
        (at.run / name).parent.mkdir(exist_ok=True)
        pipe(at.run / name)

    return plant


LINKS = {
    "the metrics": _linked_file("metrics.jsonl", '{"iteration": 1}\n'),
    "a pipe as the metrics": _piped("metrics.jsonl"),
    "the lock": _linked_file(".lock"),
    "a pipe as the lock": _piped(".lock"),
    "the newest checkpoint's name": _linked_file("checkpoints/latest"),
    "a file of another user": _linked_file("notes.txt"),
    "the checkpoints": _linked_folder("checkpoints"),
    "TensorBoard's folder": _linked_folder("tb"),
    "the videos": _linked_folder("videos"),
    "the exports": _linked_folder("exports"),
    "a link that leads nowhere": lambda at: link(at.run / "tb", at.cwd / "not-there"),
}
"""Refused by commands that write to the run, with exit code 5; nothing outside of the run changes."""


def place(tmp_path, run):
    """Copy a good run to a new folder, with a malicious task beside it. Return the paths, with that of the canary."""
    cwd = tmp_path / "cwd"
    runs = cwd / "runs" / "cartpole"
    runs.mkdir(parents=True)
    copy = runs / "untrusted-run"
    shutil.copytree(run, copy)
    canary = tmp_path / "canary"
    evil = evil_task(cwd / "evil", canary, (run / "config.yaml").read_text())
    return SimpleNamespace(run=copy, evil=evil, cwd=cwd, canary=canary)


def outside(at):
    """Return the names and contents of all plain files beside the run."""
    files = [file for file in sorted(Path(at.cwd).rglob("*")) if not file.is_relative_to(at.run)]
    return {str(file): file.read_bytes() if file.is_file() else None for file in files}
