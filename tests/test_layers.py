"""The structure of the package: order of its folders, no import circles, short modules, light imports."""

import ast
import functools
import subprocess
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import rlcli

PACKAGE = Path(rlcli.__file__).parent
REPOSITORY = PACKAGE.parent
LAYERS = """
    errors task trainers formats random machine settings safe_text progress
    registry  config  sim  scene  managers  envs  mdp  rl  runs  replay  evaluation  deploy  viewer  reporting  testing
    training  adapters  tuning  doctor  scaffold_mjcf_copy  scaffold_mjcf  scaffold_robot  scaffold  api  cli
    gym  pytest_plugin
"""
"""Lowest first. All names of the first line are one layer; each later name is a separate layer."""
TRAINERS = sorted(file.parent.name for file in PACKAGE.glob("rl/*/config.py"))
"""Folders of the built-in trainers in `rl/`."""
INNER = [
    f"rl < {' '.join(f'rl.{name}' for name in TRAINERS)}",
    "mdp < mdp.rewards mdp.randomization",
    "cli.ui < cli.commands < cli.app",
]
"""Orders within a folder: its own modules, and its subfolders."""
ANYWHERE = {"rlcli", "rlcli.__main__"}
"""The package, which imports nothing, and the module that starts the command line."""
MOST_LINES = 450

HEAVY = {"torch", "mujoco", "numpy", "stable_baselines3", "gymnasium"}
LIGHT = [
    "errors.py",
    "task.py",
    "trainers.py",
    "formats.py",
    "settings.py",
    "safe_text.py",
    "config",
    "registry",
    "doctor",
    "scaffold.py",
    "cli",
    "rl/trainer.py",
    "envs/observers.py",
    "training/signals.py",
    *(f"rl/{name}/config.py" for name in TRAINERS),
    "rl/distributed.py",
    "evaluation/stress_parameters.py",
    "reporting/heat_map.py",
]
"""Modules that are imported before a configuration has been checked."""


def module_name(file):
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def ranks():
    first, *rest = LAYERS.strip().splitlines()
    return dict.fromkeys(first.split(), 0) | {name: 1 + i for i, name in enumerate(" ".join(rest).split())}


RANKS = ranks()
FILES = sorted(file for file in PACKAGE.rglob("*.py") if "templates" not in file.relative_to(PACKAGE).parts)
MODULES = {module_name(file) for file in FILES}
PLUGINS = REPOSITORY / "plugins"
PLUGIN_FILES = sorted(file for file in PLUGINS.glob("*/rlcli_*/**/*.py"))
"""Modules of the plugins' packages, without their tests."""


def statements(tree):
    """Yield every statement of a module, also those inside of functions. TYPE_CHECKING blocks are skipped."""
    waiting = [tree]
    while waiting:
        node = waiting.pop(0)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                continue  # an expression contains no import
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            waiting.append(child)
            yield child


@functools.cache
def imports(file, *, everywhere=True):
    """Return (line, module) of each import in a file, or only of top-level ones. TYPE_CHECKING blocks are skipped."""
    return list(_imports(file, everywhere))


def _imports(file, everywhere):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in statements(tree) if everywhere else tree.body:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import"
            base = node.module or ""
            for alias in node.names:
                inner = PACKAGE.parent / base.replace(".", "/") / alias.name
                is_module = base.startswith("rlcli") and (inner.with_suffix(".py").exists() or inner.is_dir())
                yield node.lineno, f"{base}.{alias.name}" if is_module else base


def own_imports(file):
    """Return (line, module) of each import of the package's own modules in a file."""
    return [(line, name) for line, name in imports(file) if name.split(".")[0] == "rlcli" and name != "rlcli"]


def folder(module):
    """Return the folder: `rlcli.rl.ppo.loss` -> `rl.ppo`, `rlcli.rl.policy` -> `rl`, `rlcli.cli.app` -> `cli.app`."""
    inner = module.removeprefix("rlcli.")
    if inner == "cli.app" or (PACKAGE / inner.replace(".", "/")).is_dir():
        return inner
    return inner.rpartition(".")[0] or inner


def test_every_module_belongs_to_a_layer():
    tops = {name.split(".")[1] for name in MODULES - ANYWHERE}
    assert tops == set(RANKS)


def test_every_trainer_folder_has_an_entry_point():
    entry_points = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["entry-points"]
    registered = {place.partition(":")[0] for place in entry_points["rlcli.trainers"].values()}
    assert registered == {f"rlcli.rl.{name}.config" for name in TRAINERS}


def test_modules_import_only_own_and_lower_layers():
    wrong = [
        f"{file}:{line}: {module_name(file)} imports {imported}"
        for file in FILES
        if module_name(file) not in ANYWHERE
        for line, imported in own_imports(file)
        if RANKS[imported.split(".")[1]] > RANKS[module_name(file).split(".")[1]]
    ]
    assert wrong == []


@pytest.mark.parametrize("order", INNER)
def test_order_of_subfolders(order):
    levels = {name: level for level, names in enumerate(order.split(" < ")) for name in names.split()}
    wrong = []
    for file in FILES:
        name = module_name(file)
        own = levels.get(folder(name))
        # the __init__ of a package of terms exports the names of all its modules
        if own is None or (file.name == "__init__.py" and order.startswith("mdp")):
            continue
        for line, imported in own_imports(file):
            if levels.get(folder(imported), own) > own:
                wrong.append(f"{file}:{line}: {name} imports {imported}")
    assert wrong == []


def test_no_import_circle():
    graph = {module_name(file): {name for _, name in own_imports(file)} & MODULES for file in FILES}
    for name, needed in graph.items():
        needed.discard(name)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail("import circle: " + " <- ".join(error.args[1]))


def test_modules_are_short():
    assert PLUGIN_FILES
    lengths = {str(file): len(file.read_text(encoding="utf-8").splitlines()) for file in [*FILES, *PLUGIN_FILES]}
    assert {name: length for name, length in lengths.items() if length > MOST_LINES} == {}


def test_imports_are_found_at_top_and_in_functions(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(
        "from typing import TYPE_CHECKING\nfrom rlcli import random\nfrom rlcli.runs.run import Run\n"
        "if TYPE_CHECKING:\n    import rlcli.cli.app\ndef f():\n    import rlcli.envs.direct\n"
    )
    assert list(imports(file)) == [
        (1, "typing"),
        (2, "rlcli.random"),
        (3, "rlcli.runs.run"),
        (7, "rlcli.envs.direct"),
    ]


@pytest.mark.parametrize("part", LIGHT)
def test_light_modules_import_nothing_heavy_at_top(part):
    path = PACKAGE / part
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    wrong = []
    for file in files:
        for line, imported in imports(file, everywhere=False):
            if imported.split(".")[0] in HEAVY:
                wrong.append(f"{file}:{line}: {imported}")
    assert wrong == []


def test_package_does_not_name_built_in_tasks():
    for file in FILES:
        assert "rlcli_tasks" not in file.read_text(encoding="utf-8"), file


def test_tasks_import_no_private_modules():
    root = REPOSITORY / "tasks" / "rlcli_tasks"
    private = [
        f"{file}:{line}: {imported}"
        for file in root.rglob("*.py")
        for line, imported in imports(file)
        if imported.startswith("rlcli.") and any(part.startswith("_") for part in imported.split("."))
    ]
    assert private == []


def test_importing_package_imports_nothing_else():
    program = "import sys; before = set(sys.modules); import rlcli; print(sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['rlcli']"


def test_training_on_cpu_loads_no_gpu_engine(tmp_path):
    words = ["train", "cartpole", "--agent", "ppo", "--device", "cpu", "--num-envs", "4", "--max-iterations", "1"]
    words += ["--logger", "none", "-q", "--runs-dir", str(tmp_path)]
    modules = [name for name in MODULES if name.startswith("rlcli.sim.warp") or name == "rlcli.sim.gpu_env_selection"]
    assert len(modules) > 3
    program = (
        f"import sys; from rlcli.cli.app import main; code = main({words!r}); "
        f"gpu = {{'warp', 'mujoco_warp', *{modules!r}}}; "
        "print(code, 'torch' in sys.modules, sorted(gpu & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 True []", done.stderr
