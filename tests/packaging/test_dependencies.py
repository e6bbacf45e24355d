"""Dependencies of the packages and the pinned versions agree."""

import tomllib

import pytest
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
