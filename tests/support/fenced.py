"""Fenced blocks of documentation pages: files that a page shows, and commands that it lists."""

import os
import re
import subprocess
import sys
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
_BLOCK = re.compile(
    r"^(?P<indent> *)(?:<!-- not run: (?P<not_run>[^\n]+?) -->\n+ *)?"
    r"```(?P<language>[^\s`]*)(?: file=(?P<file>\S+))?\n(?P<text>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    language: str
    file: str | None
    text: str
    not_run: str | None = None
    """Reason why it is not run, from the comment `<!-- not run: WHY -->` on the line above."""
    section: str = ""
    """Heading of its section."""


def all_blocks(page, below="", above=None):
    """Return the blocks of a page, or of the part from the line `below` to the line `above`."""
    text = page.read_text(encoding="utf-8")
    text = text[text.index(below) :]
    text = text[: text.index(above)] if above else text
    found, section, end = [], "", 0
    for match in _BLOCK.finditer(text):
        section = next(reversed(_HEADING.findall(text[end : match.start()])), section)
        end = match.end()
        code = textwrap.dedent(match["text"]) if match["indent"] else match["text"]
        found.append(Block(match["language"], match["file"], code, match["not_run"], section))
    return found


def blocks(page, below="", above=None):
    """Return the blocks that are run."""
    return [block for block in all_blocks(page, below, above) if block.not_run is None]


def page_path(name):
    """Return the path of a page in docs/ by its file name, which is unique."""
    (path,) = [path for path in (REPOSITORY / "docs").rglob(name) if "_build" not in path.parts]
    return path


def write_files(found, folder):
    for block in found:
        if block.file:
            file = folder / block.file
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.text, encoding="utf-8")


_PYTHON = 'python() { if [[ "$1" == *.py ]]; then PYTHONSAFEPATH= "$PY" "$@"; else "$PY" "$@"; fi; }'
"""Line that makes a script find the files of the working folder."""


def shortened(block):
    """Return a block with trainings, sweeps and evaluations of a few steps, without bars."""
    brief = (
        (r"^(rlcli train (?:(?!--max-iterations|--resume|#).)*?)(?=\s*(?:#.*)?$)", r"\1 --max-iterations 2"),
        (r"--episodes [0-9]+", "--episodes 4"),
        (r" --fail-under [^ \n]+", ""),
        (r"--trials [0-9]+", "--trials 2"),
        (r"@[0-9]+s\b", "@1s"),
    )
    text = block.text
    for long, short in brief:
        text = re.sub(long, short, text, flags=re.MULTILINE)
    return replace(block, text=text)


def run_commands(found, folder, *, site=None, languages=("sh",), run=None):
    """Run the blocks of these languages in order, as a user would. Return what they printed.

    The word `RUN` of a command stands for `run`.
    `rlcli` and `python` are this interpreter's; with `site`, pip installs there, without network, and rlcli is found
    there. (`-e` is left out: an editable installation has no target.)
    """
    script = ["set -euo pipefail", 'rlcli() { "$PY" -m rlcli "$@"; }', _PYTHON]
    script += [
        'pip() { local wanted=(); for word in "${@:2}"; do [ "$word" = -e ] || wanted+=("$word"); done; '
        '"$PY" -m pip install -q --disable-pip-version-check --no-deps --no-index --no-build-isolation'
        ' --target "$SITE" "${wanted[@]}"; }'
    ]
    wanted = [block for block in found if block.language in languages and not block.file]
    assert wanted, "a page without commands"
    for block in wanted:
        text = block.text if run is None else re.sub(r"\bRUN\b", str(run), block.text)
        script.append(f"\"$PY\" - <<'END'\n{text}END" if block.language == "python" else text)
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PY": sys.executable,
        "SITE": str(site),
        "PYTHONSAFEPATH": "1",
        "HOME": str(folder / "home"),
        "XDG_CACHE_HOME": str(folder / "home" / ".cache"),
    }
    if site is not None:
        environment["PYTHONPATH"] = str(site)
    (folder / "home").mkdir(exist_ok=True)
    done = subprocess.run(
        ["bash", "-c", "\n".join(script)], cwd=folder, env=environment, capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 0, f"exit {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def success_rate(output):
    """Return the first printed success rate: that of the trained policy."""
    return success_rates(output)[0]


def success_rates(output):
    """Return the success rate of each evaluation."""
    return [float(rate) for rate in re.findall(r"^success rate +(\S+)", output, re.MULTILINE)]
