"""Installed distributions, created from files in a folder on the path."""

import os
import subprocess
import sys
import textwrap

import pytest

from support.broken_plugins import BROKEN, FILES, SPEC


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
    for module in set(sys.modules) - before:
        if not module.startswith(("rlcli", "pydantic")):
            del sys.modules[module]


@pytest.fixture
def broken_plugins(plugins):
    """Return broken_plugins(*names), which installs some of `BROKEN`, and a distribution `good` that works."""

    def install(*names):
        plugins("good", SPEC, files=FILES)
        for name in names:
            plugins(name, BROKEN[name].source, **BROKEN[name].options)

    return install


@pytest.fixture
def spec():
    return SPEC


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
