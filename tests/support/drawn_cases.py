"""Draw task files with overrides, and models, by their grammars; run the command `validate` on each in a child process.

    python tests/support/drawn_cases.py --seed 20261127 --yaml 10000 --mjcf 2000

Every command must end within 10 s of processor time and 2 GiB of memory, with a documented exit code and without a
traceback. Every line of a message names its place and repeats at most 200 characters of the input. The seed, the counts
of exit codes, the slowest case, the largest memory and the bad cases are printed; with bad cases the exit code is 1.
"""

import argparse
import contextlib
import functools
import io
import json
import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from rlcli.cli.app import main
from support import mjcf_grammar, yaml_grammar
from support.case_runs import in_children

SECONDS, MEMORY, BATCH = 10, 2 * 1024**3, 50
CODES = (0, 2, 3, 4, 7, 8)


def validate(*words):
    """Run `rlcli validate ./task` in this process; return its exit code and what it prints on stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["validate", "./task", *words])
    return code, err.getvalue()


def yaml_case(seed, originals):
    """Write a task file; return the words of the command line, the texts that messages repeat, and the exit codes."""
    text, words = yaml_grammar.case(seed, originals)
    Path("task/task.yaml").write_text(text, encoding="utf-8", errors="surrogatepass")
    return words, [text, *words], yaml_grammar.CODES


def mjcf_case(seed, _):
    """Write a task with a drawn model; return the same as `yaml_case`."""
    Path("task/task.yaml").write_text(mjcf_grammar.TASK)
    return ["--deep"], mjcf_grammar.write(seed, Path("task")), CODES


def run_case(make, originals, seed):
    """Run a case; return its exit code and what is wrong with its messages, as JSON."""
    words, given, allowed = make(seed, originals)
    code, printed = validate(*words)
    return json.dumps([code, yaml_grammar.complaint(code, printed, 0.0, given, allowed)])


def draw(kind, make, seeds, originals):
    """Run cases; print the bad ones and the counts; return the number of bad ones."""
    codes, bad, slowest, largest, total = {}, 0, (0.0, 0), (0, 0), 0.0
    function = functools.partial(run_case, make, originals)
    for number, (seed, ended) in enumerate(in_children(function, seeds, SECONDS, MEMORY, BATCH), 1):
        code, wrong = ("none", ended.wrong) if ended.wrong else json.loads(ended.text)
        codes[code] = codes.get(code, 0) + 1
        slowest, largest = max(slowest, (ended.seconds, seed)), max(largest, (ended.memory >> 20, seed))
        total += ended.seconds
        bad += bool(wrong)
        if wrong:
            print(f"{kind} seed {seed}: {wrong} {ended.text[:300] if ended.wrong else ''}", flush=True)
        if number % 500 == 0 or number == len(seeds):
            ends = ", ".join(f"exit {code}: {count}" for code, count in sorted(codes.items(), key=str))
            print(
                f"{number} {kind} cases from seed {seeds[0]}: {ends}; {bad} bad; "
                f"slowest {slowest[0]:.1f} s (seed {slowest[1]}), all {total:.0f} s of processor time; "
                f"largest memory {largest[0]} MB (seed {largest[1]})",
                flush=True,
            )
    return bad


def run(seed, numbers, start):
    """Draw YAML and MJCF cases, from number `start` on, in the current folder; return the number of bad ones."""
    os.environ["RLCLI_STATE_DIR"] = str(Path("state").absolute())
    Path("task").mkdir()
    Path("task/model.xml").write_text(mjcf_grammar.RICH)
    Path("task/part.xml").write_text(mjcf_grammar.PART)
    Path("task/task.yaml").write_text(mjcf_grammar.TASK)
    found = validate("--deep")  # imports every module, so that the children do not
    assert found[0] == 0, found
    originals = yaml_grammar.documents()
    kinds = {"YAML": yaml_case, "MJCF": mjcf_case}
    seeds = {kind: range(100_000 * seed + start, 100_000 * seed + numbers[kind]) for kind in kinds}
    return sum(draw(kind, kinds[kind], seeds[kind], originals) for kind in kinds if len(seeds[kind]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, required=True, help="seed of the draw; case i has the seed 100000 SEED + i")
    parser.add_argument("--yaml", type=int, default=10_000, metavar="NUMBER", help="number of task files")
    parser.add_argument("--mjcf", type=int, default=2_000, metavar="NUMBER", help="number of models")
    parser.add_argument("--start", type=int, default=0, metavar="I", help="first case, to continue a draw")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        sys.exit(run(chosen.seed, {"YAML": chosen.yaml, "MJCF": chosen.mjcf}, chosen.start) > 0)
