"""Virtual environment with only the given requirements: no network, no copies.

What is there comes from this interpreter's own installation, linked one distribution at a time. So a package that rlcli
imports and does not declare is missing there, as it is on a user's machine.
"""

import subprocess
import sys
import tomllib
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).parents[2]
OWN = "rlcli"


def requirements_of_rlcli(*extras):
    """Return the requirements in rlcli's pyproject.toml, with some of its extras."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in extras:
        for line in project["optional-dependencies"][extra]:
            inner = Requirement(line)
            wanted += requirements_of_rlcli(*inner.extras) if inner.name == OWN else [line]
    return wanted


def distributions(requirements) -> dict[str, Distribution]:
    """Return the installed distributions that fulfil the requirements, and their dependencies."""
    found: dict[str, Distribution] = {}
    seen = set()
    waiting = [(Requirement(line), "") for line in requirements]
    while waiting:
        wanted, extra = waiting.pop()
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        name = wanted.name.lower().replace("_", "-")
        assert name != OWN, "an environment without rlcli"
        installed = found.setdefault(name, distribution(name))
        for extra in ("", *wanted.extras):
            if (name, extra) not in seen:
                seen.add((name, extra))
                waiting += [(Requirement(line), extra) for line in installed.requires or ()]
    return found


def make(folder, requirements):
    """Create the environment in `folder`; return its Python."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = folder / "bin" / "python"
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(subprocess.run([python, "-c", ask], capture_output=True, text=True, check=True).stdout.strip())
    for installed in distributions(requirements).values():
        origin = Path(installed.locate_file(""))
        tops = {file.parts[0] for file in installed.files or () if file.parts[0] not in ("..", "__pycache__")}
        for top in tops:
            if not (site / top).exists():
                (site / top).symlink_to(origin / top)
    return python
