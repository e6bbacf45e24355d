"""Random installed plugins: hostile metadata, names and entry points, and specs whose parts have wrong types or fail.

Each case writes one to three distributions into a folder on the import path and runs a command, which must end with a
documented exit code, without a traceback, in little time; every line of it is short and has no control characters.
"""

import contextlib
import importlib
import io
import os
import random
import resource
import signal
import sys
import time
from pathlib import Path

from rlcli.cli.app import main
from rlcli.registry import formats, framework_imports
from support.case_runs import run_cases

SECONDS = 10
CODES = (0, 2, 3, 4, 5, 6, 7, 8, 9, 10)
GROUPS = ("rlcli.tasks", "rlcli.trainers", "rlcli.formats")
TEXTS = [
    "",
    " ",
    "x",
    "cartpole",
    "sb3",
    "ppo",
    "oige",
    "rlcli",
    "latest",
    "shipped",
    "./x",
    "a/b",
    "a:b",
    "--help",
    "-x",
    "[x]",
    "\x1b[31mred",
    "\u202eevil",
    "a\rb",
    "\x00",
    "n" * 3000,
    "w " * 1500,
    "'" * 300,
    "\U0001f916",
    "\x85x",
    "..",
    "=",
    "%s{0}",
    "a\nhint: run: curl x | sh",
    "a\n b",
    "None",
    "é" * 500,
    "(a+)+$",
    "*",
    "\x7f",
    "\u2028error: x",
    "A B",
    "#c",
]
VALUES = [
    None,
    True,
    0,
    -1,
    2**70,
    1.5,
    float("nan"),
    [],
    {},
    (),
    [1],
    {"a": 1},
    {1: 2},
    {"a": {"b": None}},
    b"x",
    "SPEC",
]
TARGETS = [
    "{package}:SPEC",
    "{package}",
    "{package}:",
    ":SPEC",
    "{package}:no.such",
    "no_such_module:SPEC",
    "..:x",
    "a b:c",
    "{package}.inner:SPEC",
    "{package}:__name__",
    "{package} : SPEC",
    "{package}:SPEC [extra]",
    "os:system",
    "sys:exit",
    ".{package}:SPEC",
    "{package}..x:SPEC",
    "1x:y",
    "{package}:SPEC:SPEC",
    "__main__:main",
    "rlcli:__version__",
]
BODIES = [
    "return {value}",
    "return {text}",
    "yield {value}",
    "yield {value}, {value}, {value}",
    "yield ('a', 'b'), {text}, {text}",
    "raise ValueError({text})",
    "raise SystemExit({value})",
    "raise KeyError",
    "raise RuntimeError({text}) from None",
    "raise type({text}[:40].replace(chr(0), ''), (Exception,), {{}})({text})",
    "return print(1)",
    "return object()",
    "import logging; logging.getLogger('p').warning({text})",
    "import warnings; warnings.warn({text})",
    "return {package}",
    "return Translation({value}, {value}, {value})",
    "return Translation({{}}, lambda path: {value}, [{value}])",
    "return Translation({{'rewards': {value}}}, lambda path: Origin('task', {text}), [])",
    "return Translation({{'decimation': 1}}, lambda path: Origin('task', 'a'), [Note({text}, 'a', 'mapped', {text})])",
    "return TaskSource({text}, Path('.'), Path({text}.replace(chr(0), '')))",
    "return lambda: {value}",
    "return [Path({text})]",
]
FIELDS = {
    "rlcli.tasks": ("TaskSpec", ["package", "summary", "config", "task", "terms", "agents", "policies", "api"]),
    "rlcli.trainers": ("TrainerSpec", ["summary", "algorithms", "trainer", "refused", "parallel", "gpu", "api"]),
    "rlcli.formats": (
        "FormatSpec",
        [
            "summary",
            "find",
            "read",
            "key",
            "check",
            "open_scene",
            "environment",
            "importer",
            "hint",
            "agents_beside",
            "models",
            "agent_file",
            "agent_order",
            "aliases",
            "api",
        ],
    ),
}
GOOD = {
    "rlcli.tasks": {"package": "{package}", "summary": "A task."},
    "rlcli.trainers": {
        "summary": "A trainer.",
        "algorithms": {"ppo": "rlcli.rl.ppo.config:PpoConfig"},
        "trainer": "{package}:f",
    },
    "rlcli.formats": {
        "summary": "tasks",
        "find": "{package}:f",
        "read": "{package}:f",
        "key": "foreign_key",
        "check": "{package}:f",
        "importer": "{package}:f",
        "hint": "{package}:f",
        "models": "a.{{name}}",
        "aliases": {"omni": "{package}"},
    },
}
MODULE = """\
from pathlib import Path
from rlcli.config.layers import Origin
from rlcli.formats import FormatSpec, Note, Translation
from rlcli.registry import TaskSource
from rlcli.task import TaskSpec
from rlcli.trainers import TrainerSpec
package = __name__
def f(*arguments, **settings):
    {body}
SPEC = {spec}(**{fields})
"""
TASK = """\
summary: Slide.
decimation: 1
episode_length_s: 0.2
sim: {dt: 0.01}
scene: {num_envs: 5, entities: {robot: {model: model.xml}}}
actions: {push: {func: joint_effort, joints: [j]}}
observations: {policy: {pos: {func: joint_pos_rel}}}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
agents: {default: ppo, ppo: {trainer: sb3, algorithm: ppo, max_iterations: 1, n_steps: 8, num_minibatches: 1}}
"""
MODEL = "<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='.1' mass='1'/></body></worldbody></mujoco>"
COMMANDS = [
    ("list-tasks", "no such task"),
    ("validate", "cartpole"),
    ("validate", "./task"),
    ("validate", "./foreign"),
    ("validate", "./none"),
    ("validate", "./python/task.py:TASK"),
    ("validate", "./task", "agent.trainer={name}"),
    ("validate", "./task", "agent.trainer={distribution}:{name}"),
    ("validate", "{name}"),
    ("validate", "{distribution}:{name}"),
    ("import", "--help"),
    ("import", "{name}", "nowhere.yaml"),
    ("import", "{name}", "--help"),
    ("show", "cartpole", "sim"),
    ("terms",),
    ("validate", "no-such-task"),
    ("validate", "./task", "agent.trainer=nothing"),
    ("new", "{name}"),
    ("runs",),
    ("validate", "./none", "--model", "x=model.xml"),
    ("show", "{name}"),
    ("validate", "./foreign", "--deep"),
    ("train", "--help"),
    ("eval", "{name}", "--policy", "zero", "--episodes", "1"),
    ("diff", "{name}", "cartpole"),
]


def code(draw, package):
    """Return a literal or an expression of Python for a hostile value."""
    choice = draw.randrange(3)
    return repr(draw.choice(VALUES) if choice else draw.choice(TEXTS)).replace("nan", "float('nan')")


def module(draw, group, package):
    """Return the source of a module with a spec."""
    if draw.random() < 0.1:
        return draw.choice(
            ["", "SPEC = None\n", "raise ValueError({!r})\n", "def f(:\n", "import no_such_{!r}\n"]
        ).format(draw.choice(TEXTS))
    spec, names = FIELDS[group]
    fields = {
        name: repr(value).replace("{package}", package).replace("{{", "{").replace("}}", "}")
        for name, value in GOOD[group].items()
        if draw.random() < 0.9
    }
    for _ in range(draw.choice([0, 1, 1, 2])):
        fields[draw.choice(names)] = code(draw, package)
    body = draw.choice(BODIES).format(value=code(draw, package), text=repr(draw.choice(TEXTS)), package="package")
    written = "{" + ", ".join(f"{name!r}: {value}" for name, value in fields.items()) + "}"
    return MODULE.format(body=body, spec=spec, fields=written)


def distribution(draw, site, package):
    """Write a distribution into a folder; return the name and one entry point's name."""
    group = draw.choice(GROUPS)
    (site / package).mkdir()
    (site / package / "__init__.py").write_text(
        module(draw, group, package), encoding="utf-8", errors="surrogateescape"
    )
    (site / package / "task.yaml").write_text(TASK)
    (site / package / "model.xml").write_text(MODEL)
    if draw.random() < 0.2:
        index = draw.choice(
            ["[" * 50_000, "{}", "[]", '{"%s": {"summary": 5}}', '{"%s": {"summary": "\\u001b[31m\\n"}}', "\udcff"]
        )
        (site / package / "index.json").write_text(index, encoding="utf-8", errors="surrogateescape")
    name, version = f"{package}-x", "1.0"
    if draw.random() < 0.25:
        name = draw.choice(TEXTS)
    if draw.random() < 0.15:
        version = draw.choice(TEXTS)
    point = draw.choice([f"{package}-point", draw.choice(TEXTS)])
    target = "{package}:SPEC" if draw.random() < 0.7 else draw.choice(TARGETS)
    lines = [f"[{group}]", f"{point} = {target.format(package=package)}"]
    kind = draw.randrange(12)
    if kind == 0:
        lines += [f"point{number} = {package}:SPEC" for number in range(draw.choice([60, 10_000]))]
    elif kind == 1:
        lines.insert(draw.randrange(3), draw.choice([*TEXTS, f"[{draw.choice(GROUPS)}]", "[", "]", "no sign", "= x:y"]))
    elif kind == 2:
        lines += [f"[{other}]\n{point} = {package}:SPEC" for other in GROUPS]
    folder = f"{package}-1.0.dist-info"
    if draw.random() < 0.1:
        folder = draw.choice(
            [
                "\x1b[31m{}.dist-info",
                "\udcff{}-1.0.dist-info",
                "{}\nhint: run: curl x-1.0.dist-info",
                "{}.egg-info",
                "{}-1.0-2.0-3.dist-info",
                "{}.dist-info",
            ]
        ).format(package)
    info = site / folder
    info.mkdir()
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    kind = draw.randrange(20)
    if kind == 0:
        metadata = draw.choice(["", "\udcff", "Name\n", "\n\n" + metadata, metadata * 3, metadata + "Name: other\n"])
    elif kind == 1:
        metadata += "".join(
            f"Requires-Dist: {draw.choice(TEXTS)}>={number}\n" for number in range(draw.choice([1, 5000]))
        )
    elif kind == 2:
        metadata += f"Requires-Dist: rlcli>={draw.choice(['99', '9' * 5000, '1.' * 900 + '1', 'x'])}\n"
    (info / "METADATA").write_bytes(metadata.encode("utf-8", "surrogateescape"))
    (info / "entry_points.txt").write_bytes("\n".join([*lines, ""]).encode("utf-8", "surrogateescape"))
    if draw.random() < 0.7:
        (info / "RECORD").write_text(draw.choice(["", "x", ",,,\n" * 3, "\0"]))
    elif draw.random() < 0.3:
        (info / "RECORD").mkdir()
    if draw.random() < 0.06:
        file = info / draw.choice(["METADATA", "entry_points.txt"])
        file.unlink()
        draw.choice(
            [lambda: None, file.mkdir, lambda: file.symlink_to(file.name), lambda: file.write_bytes(b"\xff\xfe\0")]
        )()
    return name, point


def write(draw, folder, tag):
    """Write the distributions and the tasks of a case; return the words of its command."""
    site = folder / "site"
    site.mkdir()
    found = [distribution(draw, site, f"plug_{tag}_{number}") for number in range(draw.choice([1, 1, 2, 3]))]
    name, point = draw.choice(found)
    for task, more in (("task", ""), ("foreign", "foreign_key: {a: 1}\n"), ("python", "")):
        (folder / task).mkdir()
        (folder / task / "task.yaml").write_text(TASK + more)
        (folder / task / "model.xml").write_text(MODEL)
    (folder / "none").mkdir()
    (folder / "none" / "cfg.yaml").write_text("a: 1\n")
    (folder / "python" / "task.py").write_text("import omni.x\nTASK = None\n")
    values = {"name": point, "distribution": name}
    return [word.format(**values).replace("\0", "")[:100_000] for word in draw.choice(COMMANDS)]


def run(seed, folder):
    """Run a case in this process; return its exit code and what is wrong (empty: nothing)."""
    draw = random.Random(seed)
    words = write(draw, folder, seed)
    site = str(folder / "site")
    for cache in (formats._framework_packages, formats.aliasing_formats, framework_imports._formats_for):
        cache.cache_clear()
    import rlcli.cli.commands

    sys.modules.pop("rlcli.cli.commands.import_", None)
    vars(rlcli.cli.commands).pop("import_", None)
    sys.path.insert(0, site)
    importlib.invalidate_caches()
    out, err = io.StringIO(), io.StringIO()
    begin, result = time.process_time(), None
    signal.signal(signal.SIGALRM, _hang)
    signal.alarm(20 * SECONDS)
    try:
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            result = main(words)
    except BaseException as error:
        return None, f"{words!r:.200}: {type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
        sys.path.remove(site)
        sys.path_importer_cache.pop(site, None)
        for name in [name for name in sys.modules if name.startswith("plug_")]:
            del sys.modules[name]
    seconds = time.process_time() - begin
    wrong = complaint(result, out.getvalue(), err.getvalue(), seconds)
    return result, wrong and f"{words!r:.200}: {wrong}"


def _hang(*_):
    raise TimeoutError("hang")


def complaint(result, out, err, seconds):
    """Return what is wrong with the output of a command."""
    if "Traceback" in err or "bug in rlcli" in err or result not in CODES:
        return f"exit {result}: {err[-2500:]}"
    if seconds > SECONDS:
        return f"{seconds:.0f} s"
    for line in (out + err).split("\n"):
        if line.startswith(("hint: run: curl", "error: x")):
            return f"foreign line {line[:200]!r}"
        if len(line) > 2500 or any(c in line for c in "\x00\x1b\r\x7f\x85\u202e\u2028") or "n" * 201 in line:
            return f"long or unsafe line: {line[:300]!r}"
    return "" if not result or result == 9 or "error: " in err else "no message"


def run_all(first, count, folder):
    """Run cases; print each bad one and the counts; return the number of bad ones."""
    return run_cases(lambda seed: run(seed, folder), first, count, folder)


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
    os.environ["RLCLI_STATE_DIR"] = f"{sys.argv[3]}-state"
    os.environ["XDG_CACHE_HOME"] = f"{sys.argv[3]}-cache"
    sys.exit(run_all(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]).resolve()) > 0)
