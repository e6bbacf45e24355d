"""Dependencies of the packages and the pinned versions agree."""

import json
import subprocess
import sys
import tomllib
from importlib import metadata

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.fenced import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def pinned():
    lines = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if not line.startswith("#")]
    names = [canonicalize_name(name) for name, _ in pins]
    assert len(set(names)) == len(names), "a package with two pins"
    return dict(zip(names, (version for _, version in pins), strict=True))


@pytest.mark.parametrize("extra", [None, *EXTRAS])
def test_dependencies_are_pinned_within_bounds(extra):
    pins = pinned()
    wanted = [Requirement(line) for line in (PROJECT["dependencies"] if extra is None else EXTRAS[extra])]
    assert wanted
    for requirement in wanted:
        name = canonicalize_name(requirement.name)
        if name == PROJECT["name"]:
            assert requirement.extras <= set(EXTRAS)
        else:
            assert requirement.specifier.contains(pins[name]), name


def test_dependency_bounds_are_lower_bounds():
    every = [Requirement(line) for lines in (PROJECT["dependencies"], *EXTRAS.values()) for line in lines]
    assert {bound.operator for requirement in every for bound in requirement.specifier} == {">="}


@pytest.mark.parametrize("name", ["rlcli-rsl-rl", "rlcli-rl-games"])
def test_trainer_plugin_dependencies_are_pinned(name):
    project = tomllib.loads((REPOSITORY / "plugins" / name / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [Requirement(line) for line in project["dependencies"]]
    library = [requirement for requirement in wanted if requirement.name != "rlcli"]
    assert len(library) == 1
    assert library[0].specifier.contains(pinned()[canonicalize_name(library[0].name)])
    assert "<" in str(library[0].specifier)


@pytest.mark.parametrize("library", ["rsl-rl-lib", "rl-games"])
def test_pins_fulfil_requirements_of_trainer_libraries(library):
    try:
        lines = metadata.requires(library) or []
    except metadata.PackageNotFoundError:
        pytest.skip(f"{library} is not installed")
    needed = [each for each in map(Requirement, lines) if each.marker is None or each.marker.evaluate({"extra": ""})]
    pins = pinned()
    both = [each for each in needed if canonicalize_name(each.name) in pins]
    assert [str(each) for each in both if not each.specifier.contains(pins[canonicalize_name(each.name)])] == []


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("version", ["3.11.0", "3.11.2", "3.11.4", "3.12.0", "3.13.0"])
def test_pins_resolve_for_python(version, tmp_path):
    """Every pin has a wheel for this Python, and the pins fulfil each other's requirements.

    torch is left out: PyPI's build brings gigabytes.
    """
    pins = pinned()
    wanted = tmp_path / "pins.txt"
    wanted.write_text("".join(f"{name}=={pin}\n" for name, pin in pins.items() if name != "torch"))
    report = tmp_path / "report.json"
    options = ["--dry-run", "--ignore-installed", "--no-deps", "--only-binary=:all:", "--target", tmp_path / "site"]
    asked = [sys.executable, "-m", "pip", "install", "-q", *options, "--python-version", version, "--report", report]
    done = subprocess.run([*map(str, asked), "-r", str(wanted)], capture_output=True, text=True)
    if "Could not fetch" in done.stderr or "No matching distribution found for absl-py" in done.stderr:
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr
    found = [each["metadata"] for each in json.loads(report.read_text())["install"]]
    assert {canonicalize_name(each["name"]) for each in found} == pins.keys() - {"torch"}
    marker = default_environment() | {"python_version": version.rpartition(".")[0], "python_full_version": version}
    unpinned, conflicts = set(), set()
    for each in found:
        if canonicalize_name(each["name"]) in ("rl-games", "rsl-rl-lib"):
            continue  # `make setup` installs them without their dependencies
        for requirement in map(Requirement, each.get("requires_dist", [])):
            if requirement.marker is None or requirement.marker.evaluate(marker | {"extra": ""}):
                name, other = canonicalize_name(each["name"]), canonicalize_name(requirement.name)
                if other not in pins:
                    unpinned.add(name)
                elif not requirement.specifier.contains(pins[other]):
                    conflicts.add((name, other))
    assert conflicts == {("trackio", "pillow")}  # named in pyproject.toml
    assert unpinned <= {"mlflow-skinny", "trackio", "wandb"}, "what they bring is not tested"
