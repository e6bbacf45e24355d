"""The quickstart, typed in an empty environment as its built page shows it: every command prints what is shown."""

import os
import re
import subprocess
import sys

import pytest
from support.consoles import Command, commands, difference
from support.empty_environment import make, requirements_of_rlcli
from support.fenced import REPOSITORY, page_path
from support.source_copies import copy_sources

CLOSING = (
    Command('python -c "import rlcli, rlcli_tasks; print(rlcli.__file__, rlcli_tasks.__file__)"', ""),
    Command("python -m pip check", ""),
)


@pytest.fixture
def clone(tmp_path):
    """A copy of the sources, with an environment that has what rlcli asks for, and not rlcli."""
    folder = tmp_path / "rlcli"
    copy_sources(REPOSITORY, folder, "tests", "docs")
    build = ("hatchling", "hatch-fancy-pypi-readme")  # what pip builds the wheel with
    make(folder / ".venv", [*requirements_of_rlcli("video"), *build])
    return folder


def shell(folder):
    """Environment variables of somebody whose Python is this one's, who has no network and nothing else installed."""
    programs = folder.parent / "programs"
    programs.mkdir()
    (programs / "python3").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    (programs / "python3").chmod(0o755)
    kept = {name: os.environ[name] for name in ("LANG", "OMP_NUM_THREADS", "OMP_WAIT_POLICY") if name in os.environ}
    return kept | {
        "PATH": f"{programs}:/usr/bin:/bin",
        "HOME": str(folder.parent / "home"),
        "PIP_NO_INDEX": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # pip's way to say that it is not isolated
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PYTHONUNBUFFERED": "1",
    }


def typed(found, folder):
    """What a shell prints for each command, and its exit code."""
    lines = ["exec 2>&1"]
    for command in found:
        lines += [command.text, r"printf '\n@@@%d\n' $?"]
    done = subprocess.run(
        ["bash", "-c", "\n".join(lines)], cwd=folder, env=shell(folder), capture_output=True, text=True, timeout=1700
    )
    parts = re.split(r"\n@@@(\d+)\n", done.stdout)
    return list(zip(parts[::2], map(int, parts[1::2]), strict=False))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_command_of_the_quickstart_prints_what_the_page_shows(built, clone):
    """quickstart.md, from the HTML."""
    found, allowed = [], []
    page = page_path("quickstart.md").relative_to(REPOSITORY / "docs").with_suffix("").as_posix()
    for language, text, comment in built[page].blocks:
        if comment and comment.startswith("not run: "):
            continue
        assert language == "console"
        stated = re.fullmatch(r"figures within (\d+) %", comment or "")
        found += commands(text)
        allowed += [int(stated[1]) / 100 if stated else 0.0] * (len(found) - len(allowed))
    assert len(found) > 12
    *results, (places, _), (check, broken) = typed([*found, *CLOSING], clone)
    for command, (printed, code), within in zip(found, results, allowed, strict=True):
        wrong = difference(command.printed, printed, within)
        assert wrong is None, f"$ {command.text}\n{wrong}"
        assert (code != 0) == command.printed.startswith("error:"), f"$ {command.text}: exit code {code}"
    assert places.count(str(clone / ".venv")) == 2, places
    assert not broken, check
    for video in ("shipped.mp4", "cartpole.mp4"):
        assert (clone.parent / "robots" / video).stat().st_size > 10_000
