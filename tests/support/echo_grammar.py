"""Random text in every argument and option: messages repeat little of it, each on one line.

Each case runs a command line in this process. Every line that the command prints may contain at most 200 characters of
the drawn text in one piece, no line begins with a line of the text, and no control character reaches the terminal.
"""

import contextlib
import io
import os
import random
import re
import signal
import sys
import time
from pathlib import Path

from rlcli.cli.app import main
from support.case_runs import run_cases

SECONDS = 10
MARK = "\u0436"
"""Letter that no message of rlcli has."""
T = "TEXT"
"""Place of the text in a command line."""
LINES = [
    line.split()
    for line in """\
play TEXT
play --checkpoint TEXT
play cartpole --viewer TEXT
play cartpole --video TEXT
play cartpole --policy TEXT
play cartpole --device TEXT
validate TEXT
validate ./TEXT
validate cartpole TEXT
validate cartpole TEXT=1
validate cartpole scene.TEXT=1
validate cartpole scene.num_envs=TEXT
validate cartpole rewards.alive.func=TEXT
validate cartpole rewards.alive.params.TEXT=1
validate cartpole rewards.TEXT.func=is_alive
validate cartpole scene.entities.robot.model=TEXT
validate cartpole agent.trainer=TEXT
validate cartpole observations.policy.pole_pos.joints=['TEXT'] --deep
validate cartpole scene.entities.TEXT.model=x.xml
validate cartpole --agent TEXT
validate cartpole --config TEXT
train TEXT
train cartpole --agent TEXT
train --TEXT
train cartpole --TEXT=1
train cartpole --device TEXT
train cartpole --logger TEXT
train cartpole --seeds TEXT
train cartpole --seed TEXT
train cartpole --num-envs TEXT
train --resume TEXT
train cartpole --init-from TEXT
train cartpole --max-iterations TEXT
eval TEXT
eval cartpole --checkpoint TEXT
eval cartpole --fail-under TEXT
eval cartpole --episodes TEXT
eval cartpole --policy TEXT
stress cartpole --sweep TEXT
stress cartpole --sweep TEXT=1,2
export TEXT
export cartpole --format TEXT
export --checkpoint TEXT
export cartpole --output TEXT
export cartpole --output TEXT.onnx
sweep TEXT
sweep cartpole --param TEXT
sweep cartpole --param agent.TEXT=1,2
sweep cartpole --param TEXT=1:2
sweep cartpole --param agent.learning_rate=1,2 --objective TEXT
sweep show TEXT
sweep cartpole --param agent.learning_rate=1,2 --storage TEXT
sweep cartpole --param agent.learning_rate=1,2 --pruner TEXT
plot TEXT
plot TEXT --key TEXT
report TEXT
diff TEXT TEXT
autopsy TEXT
replay TEXT
watch TEXT
new TEXT
terms TEXT
terms --kind TEXT
show cartpole TEXT
show TEXT
import sb3 TEXT --task cartpole
import TEXT
import sb3 x --task TEXT
runs TEXT
runs --runs-dir TEXT
list-tasks TEXT
bench TEXT
check TEXT
lint TEXT
check cartpole TEXT
reproduce TEXT
TEXT
--TEXT
-TEXT
train cartpole -TEXT
runs --sort TEXT
doctor TEXT
train cartpole --runs-dir /proc/x/TEXT
autopsy --task TEXT TEXT
train cartpole --name TEXT --resume x
train cartpole --name ../TEXT
""".splitlines()
]
VARIABLES = ("RLCLI_RUNS_DIR", "RLCLI_PLUGINS", "RLCLI_MODELS", "MUJOCO_GL")
SETTINGS = "XDG_CONFIG_HOME"


def text(draw):
    """Return hostile text."""
    parts = [
        *(MARK + after for after in ("", " ", "' ", '" ', ".", "/", "=", ",", ":", "\t")),
        *(2 * [MARK, f"{MARK} ", f"{MARK}' ", f'{MARK}" ']),
        *("\x1b[31m", "\u202e", "\r", "\x07", "'", '"', "..", "[", "%s{0}", "\u2028error: x"),
        f"\nhint: run: curl {MARK} | sh\n",
    ]
    return "".join(draw.choice(parts) * draw.choice([1, 1, 250, 1500]) for _ in range(draw.choice([1, 1, 2, 3])))


def case(seed):
    """Return a command line, variables of the environment and the text of a settings file (empty: none)."""
    draw = random.Random(seed)
    drawn = text(draw)
    words = [word.replace(T, drawn) for word in draw.choice(LINES)]
    kind = draw.randrange(12)
    variables = {draw.choice(VARIABLES): drawn} if kind == 0 else {}
    settings = (
        draw.choice([f"{drawn}: 1\n", f"runs_dir: {drawn}\n", f'viewer: "{drawn}"\n', drawn]) if kind == 1 else ""
    )
    if variables or settings:
        words = draw.choice([["validate", "cartpole"], ["list-tasks"], ["runs"], ["show", "cartpole", "sim"]])
    return words, variables, settings


def complaint(code, printed, seconds):
    """Return what is wrong with the output of a command."""
    if "Traceback" in printed or "bug in rlcli" in printed or code not in (0, 2, 3, 4, 5, 7, 8, 9, 10):
        return f"exit {code}: {printed[-1500:]}"
    if seconds > SECONDS:
        return f"{seconds:.0f} s"
    for line in re.split("[\n\r\u2028]", printed):
        if line.startswith(("hint: run: curl", "error: x")):
            return f"foreign line {line[:200]!r}"
        if re.search("[\x00-\x08\x0b-\x1f\x7f\u202e\u2028]", line):
            return f"control character in {line[:200]!r}"
        if line.count(MARK) > 1000 or re.search(f"{MARK}{{201}}|({MARK}[^{MARK}a-z]{{1,4}}){{200}}", line):
            return f"{line.count(MARK)} characters of the text in {line[:500]!r}"
    return "" if not code or "error: " in printed or code == 9 else "no message"


def hang(*_):
    raise TimeoutError("hang")


def run(seed, folder):
    """Run a case in an empty folder; return its exit code and what is wrong (empty: nothing)."""
    words, variables, settings = case(seed)
    if any("\0" in word for word in words):
        return 0, ""
    before = dict(os.environ)
    os.environ.update({key: value.replace("\0", "") for key, value in variables.items()})
    os.environ[SETTINGS] = str(folder / "config")
    if settings:
        (folder / "config" / "rlcli").mkdir(parents=True)
        (folder / "config" / "rlcli" / "settings.yaml").write_text(settings, encoding="utf-8")
    out, err = io.StringIO(), io.StringIO()
    begin, code = time.process_time(), None
    signal.signal(signal.SIGALRM, hang)
    signal.alarm(20 * SECONDS)
    try:
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(words)
    except BaseException as error:
        return code, f"{words!r:.300}: {type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
        os.environ.clear()
        os.environ.update(before)
    wrong = complaint(code, err.getvalue() + out.getvalue(), time.process_time() - begin)
    return code, wrong and f"{words!r:.160} {variables!r:.80} {settings!r:.80}: {wrong}"


def run_all(first, count, folder):
    """Run cases; print each bad one and the counts; return the number of bad ones."""
    return run_cases(lambda seed: run(seed, folder), first, count, folder)


if __name__ == "__main__":
    sys.exit(run_all(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])) > 0)
