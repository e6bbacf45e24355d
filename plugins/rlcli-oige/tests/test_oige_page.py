"""The example of docs/guides/omniisaacgymenvs.md works as printed."""

import re
from pathlib import Path

import pytest
import torch

import rlcli
from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

PAGE = Path(rlcli.__file__).parents[1] / "docs" / "guides" / "omniisaacgymenvs.md"
FILE = re.compile(r"```\w+ file=(\S+)\n(.*?)```", re.DOTALL)

torch.set_num_threads(1)


@pytest.fixture
def folder(tmp_path):
    found = FILE.findall(PAGE.read_text(encoding="utf-8"))
    assert [name for name, _ in found] == ["pushed/Pushed.yaml", "pushed/cart.xml", "pushed/pushed.py"]
    for name, text in found:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path / "pushed"


def test_example_validates_and_good_action_earns_more(folder):
    assert main(["validate", str(folder), "--deep"]) == 0
    returns = []
    for gain in (0.0, 1.0):
        torch.manual_seed(0)
        env = make_env(resolve(find_task(str(folder))), seed=1)
        obs = env.reset()["policy"]
        total = 0.0
        for _ in range(100):
            result = env.step((-gain * (obs[:, :1] + obs[:, 1:])).clamp(-1.0, 1.0))
            obs, total = result.obs["policy"], total + float(result.reward.mean())
        assert result.truncated.all()
        returns.append(total)
    assert returns[1] > returns[0] + 10.0


def test_example_is_imported(folder, tmp_path):
    assert main(["import", "oige", str(folder / "Pushed.yaml"), "-o", str(tmp_path / "mine")]) == 0
    assert main(["validate", str(tmp_path / "mine"), "--deep"]) == 0
