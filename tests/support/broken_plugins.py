"""Broken plugins: arguments of the fixture `plugins`, and the expected message for each."""

from dataclasses import dataclass, field
from typing import Any

IMPORT = "from rlcli.task import TaskSpec\n"
SPEC = IMPORT + "SPEC = TaskSpec(package=__name__, summary='A plugin.')\n"
MODEL = "<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='.1' mass='1'/></body></worldbody></mujoco>"
TASK = """\
summary: {summary}
decimation: 1
episode_length_s: 0.2
sim: {{dt: 0.01}}
scene: {{num_envs: 5, entities: {{robot: {{model: model.xml}}}}}}
actions: {{push: {{func: joint_effort, joints: [j]}}}}
observations: {{policy: {{pos: {{func: joint_pos_rel}}, vel: {{func: joint_vel_rel}}}}}}
rewards: {{alive: {{func: is_alive, weight: 1.0}}}}
terminations: {{time_out: {{func: time_out, time_out: true}}}}
agents: {{default: ppo, ppo: {{trainer: sb3, algorithm: ppo, max_iterations: 1, n_steps: 8, num_minibatches: 1}}}}
"""
DETAILS = {"summary": "Slide.", "workflow": "managed", "observation_size": 2, "action_size": 1, "num_envs": 5}
DETAILS |= {"agent": "ppo"}
FILES = {"task.yaml": TASK.format(summary="Slide."), "model.xml": MODEL}


@dataclass(frozen=True)
class Case:
    """A plugin. `said` is part of the reason in its row of the probe; None if its task works."""

    said: str | None
    source: str = SPEC
    options: dict[str, Any] = field(default_factory=dict)
    unreadable: bool = False
    """Whether its metadata cannot be read: it has no row, and is listed among such distributions."""
    foreign: bool = False
    """Whether it has no row because it does not belong to rlcli."""


def with_files(**changed):
    return {"files": {**FILES, **{name.replace("_", "."): text for name, text in changed.items()}}}


BROKEN = {
    "syntax-error": Case("SyntaxError", "def f(:\n"),
    "source-not-utf8": Case("SyntaxError", "", {"files": {"__init__.py": b"x = '\xff'\n"}}),
    "import-error": Case("No module named 'no_such_module'", "import no_such_module\n"),
    "raises": Case("ValueError: out of cheese", "raise ValueError('out of cheese')\n"),
    "recurses": Case("RecursionError", "def f(): f()\nf()\n"),
    "exits-with-3": Case("SystemExit: 3", "import sys\nsys.exit(3)\n"),
    "exits-with-0": Case("SystemExit: 0", "import sys\nsys.exit(0)\n"),
    "interrupts": Case("KeyboardInterrupt", "raise KeyboardInterrupt\n"),
    "ends-the-process": Case("ended the process (exit 7)", "import os\nos._exit(7)\n"),
    "ends-it-well": Case("ended the process (exit 0)", "import os\nos._exit(0)\n"),
    "crashes": Case("crashed (SIGSEGV)", "import ctypes\nctypes.string_at(0)\n"),
    "aborts": Case("crashed (SIGABRT)", "import os\nos.abort()\n"),
    "hangs": Case("did not load within", "import time\ntime.sleep(600)\n"),
    "leaves-a-thread": Case(
        "did not end within",
        "import threading, time\nthreading.Thread(target=time.sleep, args=(600,)).start()\n" + SPEC,
        with_files(),
    ),
    "leaves-a-process": Case(None, "import subprocess\nsubprocess.Popen(['sleep', '600'])\n" + SPEC, with_files()),
    "prints": Case(None, "print('hubbub')\nimport sys\nsys.stdout.write('hubbub')\n" + SPEC, with_files()),
    "prints-from-c": Case(
        None,
        "import os\nos.write(1, b'hubbub')\n" + SPEC,
        with_files(),
    ),
    "patches-json": Case("is not callable", "import json, os\nos.chdir('/')\njson.dumps = None\n" + SPEC, with_files()),
    "has-no-object": Case("AttributeError", ""),
    "is-no-spec": Case("is a dict, expected a TaskSpec", "SPEC = {'package': 'x'}\n"),
    "names-no-object": Case(
        "write MODULE:OBJECT", SPEC, {"entry_points": "[rlcli.tasks]\nnames-no-object-task = names_no_object\n"}
    ),
    "newer-api": Case("needs plugin API 99", IMPORT + "SPEC = TaskSpec(__name__, 'x', api=99)\n"),
    "api-is-text": Case(
        "api of a TaskSpec must be a whole number", IMPORT + "SPEC = TaskSpec(__name__, 'x', api='2')\n"
    ),
    "unknown-field": Case("unexpected keyword argument 'wings'", IMPORT + "SPEC = TaskSpec(__name__, 'x', wings=2)\n"),
    "no-yaml": Case("does not exist", SPEC),
    "yaml-invalid": Case("task.yaml:1:1", SPEC, with_files(task_yaml="decimation: -2\n")),
    "yaml-not-utf8": Case("task.yaml", SPEC, {"files": {"task.yaml": b"summary: \xff\n"}}),
    "model-invalid": Case("model.xml", SPEC, with_files(model_xml="<mujoco><nonsense/></mujoco>")),
    "no-terms": Case(
        "there is no module", IMPORT + "SPEC = TaskSpec(__name__, 'x', terms=('no_terms.t',))\n", with_files()
    ),
    "index-nested": Case(None, SPEC, with_files(index_json="[" * 100_000)),
    "points-malformed": Case(None, SPEC, {"entry_points": "[rlcli.tasks]\nnonsense\n"}, unreadable=True),
    "points-not-utf8": Case(None, SPEC, {"entry_points": b"\xff\xfe[rlcli.tasks]\nx = y:z\n"}, unreadable=True),
    "metadata-empty": Case(None, SPEC, {"metadata": ""}, unreadable=True),
    "metadata-nameless": Case(None, SPEC, {"metadata": "Metadata-Version: 2.1\n"}, unreadable=True),
    "metadata-not-utf8": Case(
        None,
        SPEC,
        {"metadata": b"Metadata-Version: 2.1\nName: metadata-not-utf8\nVersion: 1.0\nSummary: \xff\n"},
        unreadable=True,
    ),
    "foreign-points-malformed": Case(None, "", {"entry_points": "[console_scripts]\nnonsense\n"}, foreign=True),
    "takes-a-built-in-name": Case("does not exist", SPEC, {"task": "cartpole"}),
    "shares-a-name": Case(None, SPEC, {"task": "shared-task", **with_files()}),
    "shares-it-too": Case("does not exist", SPEC, {"task": "shared-task"}),
}
