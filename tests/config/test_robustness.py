"""Any task file gives a configuration or a list of problems, and no other exception."""

import copy
import random

import pytest
from support.fault_sizes import amount

from rlcli.config import strict_yaml
from rlcli.config.dump import to_yaml
from rlcli.config.load import resolve
from rlcli.errors import ConfigError, DependencyError
from rlcli.registry import find_task, folder_task

VALUES = [
    None,
    True,
    0,
    -1,
    3,
    1e9,
    0.5,
    "",
    "x",
    ".*",
    "1/2",
    [],
    [1],
    ["a", 2, None],
    {},
    {"a": 1},
    {"func": "is_alive"},
]


def problems_of(source, **options):
    """Return None for a valid configuration, else its problems. Any other exception fails the test."""
    try:
        resolve(source, **options)
    except ConfigError as error:
        return error.problems
    except DependencyError:
        return []
    return None


def nodes(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from nodes(item, (*path, key))


def mutate(data, draw):
    for _ in range(draw.randint(1, 3)):
        path = draw.choice([p for p in nodes(data) if p])
        target = data
        for step in path[:-1]:
            target = target[step]
        kind = draw.randrange(4)
        if kind == 0 and isinstance(target, dict):
            target[draw.choice(["x", "func", "scale", "0", "a.b", "task", "default", "weight"])] = target.pop(path[-1])
        elif kind == 1:
            del target[path[-1]]
        else:
            target[path[-1]] = copy.deepcopy(draw.choice(VALUES))


@pytest.mark.parametrize("name", ["cartpole", "cartpole-direct"])
def test_mutated_task_gives_configuration_or_problems(name, tmp_path):
    draw = random.Random(1)
    source = find_task(name)
    original = strict_yaml.load(source.config.read_bytes()).data
    (tmp_path / "task.yaml").touch()
    if source.task_file:
        (tmp_path / "task.py").write_text(source.task_file.read_text().replace("CartpoleTask", "Task"))
    folder = folder_task(tmp_path)
    accepted, count = 0, amount(50, 100)
    for _ in range(count):
        data = copy.deepcopy(original)
        mutate(data, draw)
        folder.config.write_text(to_yaml(data), encoding="utf-8")
        problems = problems_of(folder, play=draw.random() < 0.5)
        assert all(str(folder.config) in problem.where for problem in problems or []), problems
        accepted += problems is None
    assert 0 < accepted < count


def test_any_override_gives_configuration_or_problems():
    draw = random.Random(2)
    source = find_task("cartpole")
    original = strict_yaml.load(source.config.read_bytes()).data
    paths = [p for p in nodes(original) if p]
    refused, count = 0, amount(40, 80)
    for _ in range(count):
        path = draw.choice(paths)
        path = (*path[: draw.randint(1, len(path))], *draw.choices(["x", 0, "func"], k=draw.randint(0, 1)))
        value = to_yaml({"v": draw.choice(VALUES)}).strip().removeprefix("v:").strip()
        refused += problems_of(source, overrides=[f"{'.'.join(map(str, path))}={value}"]) is not None
    assert 0 < refused < count
