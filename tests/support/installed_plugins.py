"""Installed distributions, created from files in a folder on the path."""

import json
import os
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import pytest
import torch

from rlcli.cli.app import main
from support.broken_plugins import BROKEN, DETAILS, FILES, SPEC


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    """Return plugins(name, module=source, points=..., ...), which creates a distribution and puts it on the path."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    before = set(sys.modules)

    def make(name, source="", *, task=None, entry_points=None, metadata=None, version="1.0", files=None, package=None):
        package = package or name.replace("-", "_")
        folder = site / package
        folder.mkdir(exist_ok=True)
        (folder / "__init__.py").write_text(textwrap.dedent(source))
        for file, text in (files or {}).items():
            (folder / file).write_bytes(text if isinstance(text, bytes) else text.encode())
        info = site / f"{package}-{version}.dist-info"
        info.mkdir()
        if metadata is None:
            metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        if metadata is not None:
            (info / "METADATA").write_bytes(metadata if isinstance(metadata, bytes) else metadata.encode())
        task = task or f"{name}-task"
        points = f"[rlcli.tasks]\n{task} = {package}:SPEC\n" if entry_points is None else entry_points
        (info / "entry_points.txt").write_bytes(points if isinstance(points, bytes) else points.encode())
        (info / "RECORD").write_text("")
        return folder

    yield make
    packages = {folder.name for folder in site.iterdir()}
    for module in set(sys.modules) - before:
        if module.partition(".")[0] in packages:
            del sys.modules[module]


@pytest.fixture
def broken_plugins(plugins):
    """Return broken_plugins(*names), which installs some of `BROKEN`, and a distribution `good` that works."""

    def install(*names):
        plugins("good", SPEC, files={**FILES, "index.json": json.dumps({"good-task": DETAILS})})
        for name in names:
            plugins(name, BROKEN[name].source, **BROKEN[name].options)

    return install


@pytest.fixture
def spec():
    return SPEC


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    """Return command(*arguments) -> the result of `rlcli`, run in this process in an empty folder: faster than `cli`.

    Not for plugins that end or change the process when they are imported.
    """
    threads = torch.get_num_threads()

    def run(*arguments, **environment):
        here = tmp_path / "here"
        here.mkdir(exist_ok=True)
        with monkeypatch.context() as changed:
            changed.chdir(here)
            for name, value in environment.items():
                changed.setenv(name, value)
            capfd.readouterr()
            code = main([*arguments])
            out, err = capfd.readouterr()
        return SimpleNamespace(returncode=code, stdout=out, stderr=err)

    yield run
    torch.set_num_threads(threads)


@pytest.fixture
def cli(tmp_path):
    """Return cli(*arguments) -> the finished `rlcli` process, started in an empty folder."""

    def run(*arguments, **environment):
        here = tmp_path / "here"
        here.mkdir(exist_ok=True)
        command = [sys.executable, "-m", "rlcli", *arguments]
        env = {**os.environ, **environment}
        return subprocess.run(command, capture_output=True, text=True, cwd=here, env=env, timeout=120)

    return run
