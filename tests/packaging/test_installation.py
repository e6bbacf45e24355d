"""rlcli in an empty environment of each Python it is for: its wheels, what pip brings for them, and nothing else.

torch comes from the registry that pip is set up for. Where that has no build for a CPU alone (PyPI's for Linux brings
gigabytes of CUDA), everything but torch is installed, and what needs no torch is tried.
"""

import json
import os
import re
import shutil
import subprocess
import zipfile
from dataclasses import dataclass
from email.parser import Parser
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from support.fenced import REPOSITORY
from test_wheels import build

VERSIONS = ("system", "3.11", "3.12", "3.13")
PLUGINS = ("rlcli-example-acrobot", "rlcli-gymnasium", "rlcli-menagerie")
TORCH = {"torch", "stable-baselines3"}
"""Packages that cannot be installed without torch."""
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]


def interpreter(version):
    """Return a Python interpreter of this version that can create environments; skip the test without one."""
    if version == "system":
        asked = ["/usr/bin/python3", "-c", "import ensurepip, sys; assert sys.version_info >= (3, 11)"]
        if not Path(asked[0]).exists() or subprocess.run(asked, capture_output=True).returncode:
            pytest.skip("/usr/bin/python3 is older than 3.11, or cannot create environments")
        return Path(asked[0])
    found = shutil.which(f"python{version}")
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = [Path(found)] if found else []
    places += sorted(versions.glob(f"{version}.*/bin/python{version}"))
    for place in places:
        asked = [place, "-c", "import ensurepip, ssl, sys, venv; print('%d.%d' % sys.version_info[:2])"]
        if subprocess.run(asked, capture_output=True, text=True).stdout.strip() == version:
            return place
    pytest.skip(f"there is no Python {version} on this machine")


@dataclass
class Installed:
    python: Path
    torch: str | None
    """Why torch is not installed; None: it is installed."""
    folder: Path

    def run(self, *words, code=0):
        home = {"HOME": str(self.folder), "XDG_CACHE_HOME": str(self.folder / ".cache")}
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COVERAGE", "RLCLI"))}
        done = subprocess.run(
            [self.python, *map(str, words)], cwd=self.folder, env=kept | home, capture_output=True, text=True
        )
        assert done.returncode == code, f"{words}: exit {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    def rlcli(self, *words, code=0):
        return self.run(self.python.with_name("rlcli"), *words, code=code)

    def need_torch(self):
        if self.torch is not None:
            pytest.skip(self.torch)


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheels")
    for source in (REPOSITORY, *(REPOSITORY / "plugins" / name for name in PLUGINS)):
        build(source, folder)
    found = sorted(folder.glob("*.whl"), key=lambda file: (not file.name.startswith("rlcli-"), file.name))
    assert len(found) == 1 + len(PLUGINS)
    return found


@pytest.fixture(scope="module", params=VERSIONS)
def installed(request, wheels, tmp_path_factory):
    folder = tmp_path_factory.mktemp(f"python{request.param}")
    base = interpreter(request.param)
    subprocess.run([base, "-m", "venv", folder / "venv"], check=True)
    place = Installed(folder / "venv" / "bin" / "python", None, folder)
    pip = ("-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", REPOSITORY / "constraints.txt")
    report = folder / "torch.json"
    asked = [place.python, *pip, "--dry-run", "--ignore-installed", "--report", report, "torch"]
    asked = subprocess.run(list(map(str, asked)), cwd=folder, capture_output=True, text=True)
    if asked.returncode:
        pytest.skip(f"no torch for Python {request.param}, or no registry: {asked.stderr.strip().splitlines()[-1]}")
    brought = [each["metadata"]["name"] for each in json.loads(report.read_text())["install"]]
    if any(name.startswith("nvidia-") for name in brought):
        place.torch = f"the torch that pip finds for Python {request.param} brings CUDA: {len(brought)} packages"
        place.run(*pip, *(str(wanted) for wanted in required(wheels[0]) if wanted.name not in TORCH))
        place.run(*pip, "--no-deps", *wheels)
    else:
        place.run(*pip, "--find-links", wheels[0].parent, *PLUGINS)  # rlcli comes with them
    yield place
    shutil.rmtree(folder)  # gigabytes


def required(wheel):
    """Return the requirements of a wheel without extras."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        lines = Parser().parsestr(archive.read(name).decode()).get_all("Requires-Dist")
    return [wanted for wanted in map(Requirement, lines) if wanted.marker is None]


def test_installed_packages_fit_together(installed):
    done = installed.run("-m", "pip", "check", code=0 if installed.torch is None else 1)
    if installed.torch is not None:
        missing = set(re.findall(r"requires ([\w-]+), which is not installed", done.stdout))
        assert missing == TORCH
        assert len(done.stdout.splitlines()) == len(TORCH)
    else:
        assert "No broken requirements found" in done.stdout


def test_every_module_compiles_without_warning(installed):
    place = installed.run("-c", "import rlcli, pathlib; print(pathlib.Path(rlcli.__file__).parents[1])").stdout.strip()
    found = [Path(place) / name for name in ("rlcli", "rlcli_tasks", "rlcli_gymnasium", "rlcli_menagerie")]
    installed.run("-W", "error", "-m", "compileall", "-f", "-q", *found)


def test_commands_without_torch_work(installed):
    assert installed.rlcli("--version").stdout.startswith("rlcli 0.")
    rows = json.loads(installed.rlcli("list-tasks", "--json").stdout)["tasks"]
    owners = {row["distribution"] for row in rows}
    assert owners == {"rlcli", *PLUGINS}
    assert {"cartpole", "acrobot", "gym-hopper", "go1-velocity"} <= {row["name"] for row in rows}
    assert "learning_rate" in installed.rlcli("show", "cartpole").stdout
    assert "valid" in installed.rlcli("validate", "cartpole-direct").stdout
    assert "rewards.alive.wieght" in installed.rlcli("train", "cartpole", "rewards.alive.wieght=2", code=3).stderr


def test_train_play_and_eval_work(installed):
    installed.need_torch()
    small = ("--max-iterations", 2, "--num-envs", 16)
    for task in ("cartpole", "cartpole-direct", "acrobot"):
        done = installed.rlcli("train", task, *small, "--json")
        assert json.loads(done.stdout)["state"] == "finished"
    document = json.loads(installed.rlcli("eval", "cartpole", "--checkpoint", "shipped", "--json").stdout)
    assert document["success"]["rate"] > 0.9
    installed.rlcli("play", "cartpole", "--checkpoint", "shipped", "--viewer", "none")
    done = installed.rlcli("train", "cartpole", "--seeds", "0..1", *small, "--json")
    assert [run["state"] for run in json.loads(done.stdout)["runs"]] == ["finished"] * 2
    lacking = installed.rlcli("sweep", "cartpole", "--param", "agent.gamma=0.9:0.99", code=7)
    pins = installed.run("-c", "import rlcli; print(rlcli.__path__[0])").stdout.strip() + "/constraints.txt"
    assert f'pip install -c {pins} "rlcli[sweep]"' in lacking.stderr


def test_simulation_runs(installed):
    """Step a built-in model with MuJoCo's batch, which does not need torch."""
    script = (
        "import mujoco, rlcli_tasks, pathlib\n"
        "file = pathlib.Path(rlcli_tasks.__file__).parent / 'cartpole' / 'cartpole.xml'\n"
        "model = mujoco.MjModel.from_xml_path(str(file)); data = mujoco.MjData(model)\n"
        "mujoco.mj_step(model, data, 10); print(data.time > 0)"
    )
    assert installed.run("-c", script).stdout.strip() == "True"
