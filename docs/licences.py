"""Write the page of licences: the dependencies of rlcli and its plugins, their purpose and their licence."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = Path(__file__).parent / "reference" / "licences.md"
LICENCES = {
    "build": ("MIT", "building wheels and source archives"),
    "filelock": ("MIT", "file locks: one process writes a run, one process at a time starts a trial of a sweep"),
    "furo": ("MIT", "theme of the documentation"),
    "gitpython": ("BSD-3-Clause", "import of RSL-RL or rl_games, for tests of the trainer plugins"),
    "griffelib": ("ISC", "reading docstrings and signatures for the Python reference"),
    "gymnasium": ("MIT", "standard interface of environments"),
    "hatch-fancy-pypi-readme": ("MIT", "README for package indexes"),
    "hatchling": ("MIT", "build backend"),
    "hypothesis": ("MPL-2.0", "tests with random cases"),
    "imageio": ("BSD-2-Clause", "writing videos and GIFs"),
    "imageio-ffmpeg": (
        "BSD-2-Clause",
        "encoding videos; its wheels contain the program ffmpeg under the GPL, which is run, not linked",
    ),
    "jinja2": ("BSD-3-Clause", "template of the report page"),
    "jsonschema": ("MIT", "check of the JSON schema for editors"),
    "matplotlib": ("PSF-like", "plots"),
    "mlflow-skinny": ("Apache-2.0", "tracker MLflow, without its server"),
    "mujoco": ("Apache-2.0", "physics, batched simulation, viewers"),
    "mujoco-warp": ("Apache-2.0", "physics on a GPU"),
    "mypy": ("MIT", "type checks"),
    "myst-parser": ("MIT", "Markdown in Sphinx"),
    "numpy": ("BSD-3-Clause and other free licences", "arrays between MuJoCo and torch"),
    "onnx": ("Apache-2.0", "format of exported policies"),
    "onnxruntime": ("MIT", "verification of exported policies"),
    "onnxscript": ("MIT", "dependency of torch's ONNX exporter"),
    "optuna": ("MIT", "sampling and storing the trials of a sweep"),
    "platformdirs": ("MIT", "paths of the user's cache and state folders"),
    "playwright": ("Apache-2.0", "tests of web pages in a browser"),
    "psutil": ("BSD-3-Clause", "import of RSL-RL or rl_games, for tests of the trainer plugins"),
    "psycopg": ("LGPL-3.0", "tests of sweeps on PostgreSQL; not distributed, not needed to run rlcli"),
    "pydantic": ("MIT", "schema of configurations"),
    "pytest": ("MIT", "running tests"),
    "pytest-cov": ("MIT", "test coverage"),
    "pytest-timeout": ("MIT", "time limits of tests"),
    "pytest-xdist": ("MIT", "parallel tests"),
    "pyyaml": ("MIT", "reading and writing configurations"),
    "rich": ("MIT", "tables and live views in a terminal"),
    "rlcli": ("Apache-2.0", "rlcli itself, for its plugins"),
    "rl-games": ("MIT", "trainer `rl-games`"),
    "rsl-rl-lib": ("BSD-3-Clause", "trainer `rsl-rl`"),
    "ruff": ("MIT", "formatting and linting"),
    "safetensors": ("Apache-2.0", "files of weights that contain no code"),
    "scipy": ("BSD-3-Clause", "interpolation of the terrain of OmniIsaacGymEnvs' AnymalTerrain"),
    "setproctitle": ("BSD-3-Clause", "import of RSL-RL or rl_games, for tests of the trainer plugins"),
    "sphinx": ("BSD-2-Clause", "building the documentation"),
    "stable-baselines3": ("MIT", "trainer `sb3`"),
    "tensorboard": ("Apache-2.0", "logger `tensorboard`"),
    "tensorboardx": ("MIT", "import of RSL-RL or rl_games, for tests of the trainer plugins"),
    "tensordict": ("MIT", "import of RSL-RL or rl_games, for tests of the trainer plugins"),
    "torch": ("BSD-3-Clause and other free licences", "tensors, networks, gradients"),
    "trackio": ("MIT", "tracker Trackio"),
    "typer": ("MIT", "command-line interface"),
    "wandb": ("MIT", "tracker Weights & Biases"),
    "warp-lang": ("Apache-2.0", "language of the GPU kernels of MuJoCo Warp and rlcli"),
    "watchdog": ("Apache-2.0", "import of RSL-RL or rl_games, for tests of the trainer plugins"),
}
"""Normalised name -> (licence, purpose)."""
_HEAD = """# Licences

After reading this page you know the licence of rlcli and of every package that it depends on.

rlcli and its plugins are under the Apache License 2.0; the file `LICENSE` has its text. The pages of
[the built-in tasks](zoo/index.md) name the sources of their models and numbers.

`python docs/licences.py` writes this page.
"""
_TAIL = """
The dependencies of these packages have the same kinds of licence: MIT, BSD, Apache-2.0, ISC, PSF, and MPL-2.0 (certifi,
pathspec, tqdm). On Linux with a GPU, torch installs NVIDIA's CUDA libraries, which are free of charge but not free
software.
"""


def requirements() -> Iterator[tuple[str, str]]:
    """Yield every dependency of rlcli and its plugins, with the title of its section."""
    project = _project(ROOT)
    yield from (("Required", line) for line in project["dependencies"])
    for extra, lines in project["optional-dependencies"].items():
        yield from ((f"Extra `{extra}`", line) for line in lines)
    for folder in sorted((ROOT / "plugins").iterdir()):
        plugin = _project(folder)
        yield from ((f"Plugin `{plugin['name']}`", line) for line in plugin["dependencies"])
        for extra in plugin.get("optional-dependencies", {}).keys() - {"test"}:
            yield from (
                (f"Plugin `{plugin['name']}[{extra}]`", line) for line in plugin["optional-dependencies"][extra]
            )


def _project(folder: Path) -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project


def page() -> str:
    """Return the text of the page.

    Raises:
        KeyError: if a dependency is missing in `LICENCES`.
    """
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    parts: dict[str, list[str]] = {}
    for title, line in requirements():
        wanted = Requirement(line)
        name = canonicalize_name(wanted.name)
        licence, why = LICENCES[name]
        shown = f"`{wanted.name}[{','.join(sorted(wanted.extras))}]`" if wanted.extras else f"`{wanted.name}`"
        parts.setdefault(title, []).append(f"| {shown} | {wanted.specifier or 'any'} | {licence} | {why} |")
    text = [_HEAD]
    for title, rows in parts.items():
        text += [f"## {title}", "| package | version | licence | purpose |", "| --- | --- | --- | --- |", *rows, ""]
    return "\n".join(text).rstrip() + "\n" + _TAIL


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
