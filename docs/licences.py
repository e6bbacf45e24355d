"""The page of licences: what rlcli and its plugins need, why, and under which licence."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = Path(__file__).parent / "reference" / "licences.md"
LICENCES = {
    "build": ("MIT", "builds wheels and source archives"),
    "filelock": ("MIT", "one writer a run; one process at a time begins a sweep's trial"),
    "furo": ("MIT", "the look of these pages"),
    "gitpython": ("BSD-3-Clause", "RSL-RL or rl_games imports it; the trainer plugins are tested"),
    "griffelib": ("ISC", "reads docstrings and signatures for the generated Python reference"),
    "gymnasium": ("MIT", "the interface that other libraries know environments by"),
    "hatch-fancy-pypi-readme": ("MIT", "writes the README for package indexes"),
    "hatchling": ("MIT", "the build backend"),
    "hypothesis": ("MPL-2.0", "tests with drawn cases"),
    "imageio": ("BSD-2-Clause", "writes videos and GIFs"),
    "imageio-ffmpeg": (
        "BSD-2-Clause",
        "encodes videos; its wheels bring the program ffmpeg, which is under the GPL and is run, not linked",
    ),
    "jinja2": ("BSD-3-Clause", "the template of the report page"),
    "jsonschema": ("MIT", "checks the schema that editors use"),
    "matplotlib": ("PSF-like", "draws curves"),
    "mlflow-skinny": ("Apache-2.0", "the tracker MLflow, without its server"),
    "mujoco": ("Apache-2.0", "the physics, its batch, its viewers"),
    "mujoco-warp": ("Apache-2.0", "the physics on a GPU"),
    "mypy": ("MIT", "checks types"),
    "myst-parser": ("MIT", "Markdown for Sphinx"),
    "numpy": ("BSD-3-Clause and others as free", "arrays between MuJoCo and torch"),
    "onnx": ("Apache-2.0", "the format of exported policies"),
    "onnxruntime": ("MIT", "runs an exported policy to verify it"),
    "onnxscript": ("MIT", "torch's exporter needs it"),
    "optuna": ("MIT", "draws a sweep's trials and keeps them"),
    "platformdirs": ("MIT", "where a user's cache and state belong"),
    "playwright": ("Apache-2.0", "tests of pages in a browser"),
    "psutil": ("BSD-3-Clause", "RSL-RL or rl_games imports it; the trainer plugins are tested"),
    "psycopg": ("LGPL-3.0", "a sweep on PostgreSQL is tested; never shipped, never needed to run rlcli"),
    "pydantic": ("MIT", "the schema of configurations"),
    "pytest": ("MIT", "runs tests"),
    "pytest-cov": ("MIT", "counts what tests reach"),
    "pytest-timeout": ("MIT", "ends tests that hang"),
    "pytest-xdist": ("MIT", "tests on all cores"),
    "pyyaml": ("MIT", "reads and writes configurations"),
    "rich": ("MIT", "tables and live views on a terminal"),
    "rlcli": ("Apache-2.0", "itself"),
    "rl-games": ("MIT", "the trainer `rl-games`"),
    "rsl-rl-lib": ("BSD-3-Clause", "the trainer `rsl-rl`"),
    "ruff": ("MIT", "formats and lints"),
    "safetensors": ("Apache-2.0", "weights in files that run no code"),
    "setproctitle": ("BSD-3-Clause", "RSL-RL or rl_games imports it; the trainer plugins are tested"),
    "sphinx": ("BSD-2-Clause", "builds these pages"),
    "stable-baselines3": ("MIT", "the trainer `sb3`"),
    "tensorboard": ("Apache-2.0", "the logger `tensorboard`"),
    "tensorboardx": ("MIT", "RSL-RL or rl_games imports it; the trainer plugins are tested"),
    "tensordict": ("MIT", "RSL-RL or rl_games imports it; the trainer plugins are tested"),
    "torch": ("BSD-3-Clause and others as free", "tensors, networks, gradients"),
    "trackio": ("MIT", "the tracker Trackio"),
    "typer": ("MIT", "the command line"),
    "wandb": ("MIT", "the tracker Weights & Biases"),
    "warp-lang": ("Apache-2.0", "what MuJoCo Warp and rlcli's kernels are written in"),
    "watchdog": ("Apache-2.0", "RSL-RL or rl_games imports it; the trainer plugins are tested"),
}
"""Normalised name -> licence, and why it is there."""
_HEAD = """# Licences

rlcli and the plugins beside it are under the Apache License 2.0; the file `LICENSE` has its text. Where the models
and numbers of [the built-in tasks](zoo/index.md) are from, their pages say. `python docs/licences.py` writes this page.
"""
_TAIL = """
What these need in turn is under the same kinds of licence: MIT, BSD, Apache-2.0, ISC, PSF, and MPL-2.0 (certifi,
pathspec, tqdm). On Linux with a GPU, torch brings NVIDIA's CUDA libraries, which are free to use and not free software.
"""


def requirements() -> Iterator[tuple[str, str]]:
    """Every line of dependencies of rlcli and of its plugins, with the title of what it is needed by."""
    project = _project(ROOT)
    yield from (("Needed by everything", line) for line in project["dependencies"])
    for extra, lines in project["optional-dependencies"].items():
        yield from ((f"Extra `{extra}`", line) for line in lines)
    for folder in sorted((ROOT / "plugins").iterdir()):
        plugin = _project(folder)
        yield from ((f"Plugin `{plugin['name']}`", line) for line in plugin["dependencies"])


def _project(folder: Path) -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project


def page() -> str:
    """The page.

    Raises:
        KeyError: for a dependency that the table does not know.
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
        text += [f"## {title}", "| package | version | licence | why |", "| --- | --- | --- | --- |", *rows, ""]
    return "\n".join(text).rstrip() + "\n" + _TAIL


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
