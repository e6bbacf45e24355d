"""Fenced blocks of documentation pages: files that a page tells to write, and commands that it tells to run."""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
_BLOCK = re.compile(r"^```(\w*)(?: file=(\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    language: str
    file: str | None
    text: str


def blocks(page, below="", above=None):
    """The blocks of a page, or of the part that begins with the line `below` and ends before the line `above`."""
    text = page.read_text(encoding="utf-8")
    text = text[text.index(below) :]
    text = text[: text.index(above)] if above else text
    return [Block(*match.groups()) for match in _BLOCK.finditer(text)]


def write_files(found, folder):
    for block in found:
        if block.file:
            file = folder / block.file
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.text, encoding="utf-8")


def run_commands(found, folder, *, site=None):
    """Run the `sh` blocks one after the other as a user would, and return what they printed.

    `rlcli` and `python` are this interpreter's; with `site`, pip installs there, without network, and rlcli is found
    there. (`-e` is left out: an editable installation has no target.)
    """
    script = ["set -euo pipefail", 'rlcli() { "$PY" -m rlcli "$@"; }', 'python() { "$PY" "$@"; }']
    script += [
        'pip() { local wanted=(); for word in "${@:2}"; do [ "$word" = -e ] || wanted+=("$word"); done; '
        '"$PY" -m pip install -q --disable-pip-version-check --no-deps --no-index --no-build-isolation'
        ' --target "$SITE" "${wanted[@]}"; }'
    ]
    script += [block.text for block in found if block.language == "sh"]
    assert len(script) > 4, "a page without commands"
    environment = {
        **os.environ,
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
    """The first success rate that was printed: that of the trained policy."""
    return success_rates(output)[0]


def success_rates(output):
    """The success rate of each evaluation."""
    return [float(rate) for rate in re.findall(r"^success rate +(\S+)", output, re.MULTILINE)]
