"""The layers of the package: a module imports only what stands in its own layer or below it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import rlcli

PACKAGE = Path(rlcli.__file__).parent
REPOSITORY = PACKAGE.parent
LAYERS = [
    {"errors", "task", "trainers", "random", "machine"},
    {"config", "registry", "probe"},
    {"sim"},
    {"managers", "mdp", "envs", "oige"},
    {"rl", "viewer", "adapters", "testing", "pytest_plugin", "isaaclab", "diagnosis", "scaffold"},
    {"cli", "gym"},
]
ANYWHERE = {"rlcli", "rlcli.__main__"}
"""The package itself, which imports nothing, and what starts the command line."""

HEAVY = {"torch", "mujoco", "numpy", "stable_baselines3", "gymnasium"}
LIGHT = [
    "errors",
    "task",
    "trainers",
    "config",
    "registry",
    "probe",
    "diagnosis",
    "scaffold.py",
    "cli",
    "rl/trainer.py",
    "rl/sb3_config.py",
    "rl/ppo_config.py",
    "rl/distributed.py",
    "rl/sweeps.py",
    "rl/heat_map.py",
]
"""What is imported before a configuration is known to be good."""


def module_name(file):
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def level(module):
    top = module.split(".")[1]
    return next(number for number, names in enumerate(LAYERS) if top in names)


def imports(file, *, everywhere=True):
    """(line, module) of each import in a file; of those at its top alone if not everywhere. Types only do not count."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree) if everywhere else tree.body:
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import"
            base = node.module or ""
            for alias in node.names:
                inner = PACKAGE.parent / base.replace(".", "/") / alias.name
                is_module = base.startswith("rlcli") and (inner.with_suffix(".py").exists() or inner.is_dir())
                yield node.lineno, f"{base}.{alias.name}" if is_module else base


FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_module_belongs_to_a_layer():
    tops = {module_name(file).split(".")[1] for file in FILES if module_name(file) not in ANYWHERE}
    assert tops == set().union(*LAYERS)


def test_modules_import_only_their_own_layer_and_those_below():
    wrong = []
    for file in FILES:
        name = module_name(file)
        if name in ANYWHERE:
            continue
        for line, imported in imports(file):
            if imported.split(".")[0] == "rlcli" and imported != "rlcli" and level(imported) > level(name):
                wrong.append(f"{file}:{line}: {name} imports {imported}")
    assert wrong == []


def test_the_check_sees_what_it_should(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(
        "from typing import TYPE_CHECKING\nfrom rlcli import random\nfrom rlcli.rl.run import Run\n"
        "if TYPE_CHECKING:\n    import rlcli.cli.app\ndef f():\n    import rlcli.envs.direct\n"
    )
    assert list(imports(file)) == [
        (1, "typing"),
        (2, "rlcli.random"),
        (3, "rlcli.rl.run"),
        (7, "rlcli.envs.direct"),
    ]


@pytest.mark.parametrize("part", LIGHT)
def test_light_modules_import_nothing_heavy_at_their_top(part):
    place = PACKAGE / part
    files = [place] if place.suffix else sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
    wrong = []
    for file in files:
        for line, imported in imports(file, everywhere=False):
            if imported.split(".")[0] in HEAVY:
                wrong.append(f"{file}:{line}: {imported}")
    assert wrong == []


def test_nothing_knows_the_built_in_tasks_by_name():
    for file in FILES:
        assert "rlcli_tasks" not in file.read_text(encoding="utf-8"), file


def test_tasks_use_the_package_and_not_the_other_way_round():
    root = REPOSITORY / "tasks" / "rlcli_tasks"
    private = [
        f"{file}:{line}: {imported}"
        for file in root.rglob("*.py")
        for line, imported in imports(file)
        if imported.startswith("rlcli.") and any(part.startswith("_") for part in imported.split("."))
    ]
    assert private == []


def test_importing_the_package_imports_nothing_else():
    program = "import sys; before = set(sys.modules); import rlcli; print(sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['rlcli']"


def test_training_on_the_cpu_loads_nothing_of_the_gpu_engine(tmp_path):
    words = ["train", "cartpole", "--agent", "ppo", "--device", "cpu", "--num-envs", "4", "--max-iterations", "1"]
    words += ["--logger", "none", "-q", "--runs-dir", str(tmp_path)]
    program = (
        f"import sys; from rlcli.cli.app import main; code = main({words!r}); "
        "gpu = {'warp', 'mujoco_warp', *(f'rlcli.sim.{m}' for m in ('warp', 'room', 'stages', 'mask', 'kernels'))}; "
        "print(code, 'torch' in sys.modules, sorted(gpu & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 True []", done.stderr
