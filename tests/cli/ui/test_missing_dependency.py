"""Missing dependencies: which errors name a missing dependency, and the command that installs it."""

import subprocess
import sys

import pytest

from rlcli.cli.ui.missing_dependency import missing_dependency

WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == {module!r}:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)
sys.meta_path.insert(0, Absent())
from rlcli.cli.app import main
sys.exit(main({arguments!r}))
"""


@pytest.mark.parametrize(
    ("module", "arguments", "distribution"),
    [
        ("torch", ["play", "cartpole", "--viewer", "none"], "torch"),
        ("torch", ["validate", "cartpole", "--deep"], "torch"),
        ("safetensors", ["eval", "cartpole"], "safetensors"),
    ],
)
def test_command_without_a_dependency_names_the_command_that_installs_it(tmp_path, module, arguments, distribution):
    code = WITHOUT.format(module=module, arguments=arguments)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 7, done.stderr
    assert f"error: {distribution} is not installed\nhint: pip install" in done.stderr
    assert "bug" not in done.stderr


@pytest.mark.parametrize(
    ("module", "package"),
    [("warp", '"rlcli[gpu]"'), ("onnxscript", '"rlcli[export]"'), ("yaml", "pyyaml"), ("stable_baselines3", "stable-")],
)
def test_extra_of_a_missing_module_is_named(module, package):
    error = missing_dependency(ModuleNotFoundError(f"No module named '{module}'", name=module))
    assert error.exit_code == 7
    assert package in error.hint


@pytest.mark.parametrize("module", ["pandas", "torch.nothing", "rlcli.nothing", None])
def test_module_that_is_no_dependency_is_not_named(module):
    assert missing_dependency(ModuleNotFoundError("", name=module)) is None
