"""Checks of `rlcli check` about a task's files: names in the models, and the configuration as YAML."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco

from rlcli.config.dump import to_data, to_yaml
from rlcli.config.layers import leaves
from rlcli.config.load import resolve
from rlcli.config.messages import dotted
from rlcli.errors import ConfigError, listing
from rlcli.registry import model_file
from rlcli.scene.untrusted_mjcf import model_roots, read_mjcf
from rlcli.testing.findings import Finding, error_at, warning_at
from rlcli.testing.task_under_test import TaskUnderTest


def names(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that joints, actuators and bodies of the models have names, and that all names in the YAML exist."""
    for entity, config in subject.resolved.task.scene.entities.items():
        if config.model is None:
            continue  # rlcli names the elements of a shape
        root = subject.source.root
        spec = read_mjcf(model_file(root, config.model), model_roots(root, config.model))
        scalar = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]  # a root needs no name
        for word, elements in (("joint", scalar), ("actuator", list(spec.actuators)), ("body", spec.bodies[1:])):
            unnamed = [element for element in elements if not element.name]
            if unnamed:
                places = [f"on '{e.target}'" if word == "actuator" else f"in '{e.parent.name}'" for e in unnamed]
                message = f"{word} without a name: {listing(places)}; a term can select it only by its index"
                hint = f'give the {word} a name in the MJCF: <{word} name="..."/>'
                yield warning_at(f"scene.entities.{entity}: {config.model}", message, hint)


def yaml_round_trip(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the resolved configuration is the same after writing it as YAML and reading it."""
    data = to_data(subject.resolved)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "config.yaml"
        file.write_text(to_yaml(data), encoding="utf-8")
        try:
            again = to_data(resolve(replace(subject.source, config=file)))
        except ConfigError as error:
            for problem in error.problems:
                message = f"this setting cannot be read back from YAML: {problem.message}"
                hint = problem.hint or "use a value that YAML has (finite numbers, text, lists)"
                yield error_at(problem.path or subject.source.label, message, hint)
            return
    before, after = dict(leaves(data)), dict(leaves(again))
    for path in {**before, **after}:
        was, now = before.get(path), after.get(path)
        if was != now and not (isinstance(was, list | tuple) and list(was) == now):  # YAML has no tuples
            message = f"this setting is {was!r}, and {now!r} after writing and reading the configuration"
            yield error_at(dotted(path), message, "a run stores its configuration as YAML: use a value that YAML has")
