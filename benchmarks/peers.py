"""Other libraries, each in a virtual environment under `.bench`: `python benchmarks/peers.py` installs them."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from sides import CACHE, Failed

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = ROOT / "constraints.txt"
PEERS = {
    "envpool": ["envpool==1.2.5"],
    "mjlab": ["mjlab==1.6.0"],
    "rl-zoo3": ["rl_zoo3==2.9.2"],
    "rlcli": ["-e", str(ROOT), "-e", str(ROOT / "plugins" / "rlcli-gymnasium"), "rsl-rl-lib", "skrl==2.1.1"],
}
"""Virtual environment -> requirements for pip. `rlcli` has this checkout with all its pins, and the trainers that run
on its environments; the peers have pins that contradict those, except for this release's torch."""


def python(name: str) -> Path:
    """Return the Python of a peer's virtual environment, and create it if it does not exist.

    Raises:
        Failed: if pip cannot install it.
    """
    folder = CACHE / name
    executable = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    pins = CONSTRAINTS.read_text()
    if name != "rlcli":
        pins = "".join(line for line in pins.splitlines(keepends=True) if line.startswith("torch=="))
    wanted = json.dumps([sys.version, *PEERS[name], pins])
    stamp = folder / "installed.json"
    if stamp.exists() and stamp.read_text() == wanted:
        return executable
    shutil.rmtree(folder, ignore_errors=True)
    print(f"installing {name} into {folder}", file=sys.stderr, flush=True)
    _run([sys.executable, "-m", "venv", str(folder)])
    (folder / "pins.txt").write_text(pins)
    pip = [str(executable), "-m", "pip", "--disable-pip-version-check", "-q", "install"]
    _run([*pip, "-c", str(folder / "pins.txt"), *PEERS[name]])
    stamp.write_text(wanted)
    return executable


def add(name: str, *requirements: str) -> None:
    """Install a further package into a peer's virtual environment, unless it is installed.

    Raises:
        Failed: if pip cannot install it.
    """
    _run([str(python(name)), "-m", "pip", "--disable-pip-version-check", "-q", "install", *requirements])


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith("WARNING")]
        raise Failed(f"not installed: {(errors or ['pip gives no reason'])[-1].strip()[:200]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("peers", nargs="*", choices=[*PEERS, []], default=[])
    for name in parser.parse_args().peers or PEERS:
        try:
            print(f"{name}: {python(name)}")
        except Failed as error:
            print(f"{name}: {error}")


if __name__ == "__main__":
    main()
