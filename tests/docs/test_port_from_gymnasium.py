"""The port of docs/guides/gymnasium-and-sb3.md: both sides run, and are the same environment."""

import re

import pytest
from support.fenced import REPOSITORY, Block, blocks, run_commands, success_rate, write_files

PAGE = REPOSITORY / "docs" / "guides" / "gymnasium-and-sb3.md"


def script(file):
    return Block("sh", None, f"python {file}\n")


@pytest.fixture
def folder(tmp_path):
    write_files(blocks(PAGE), tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_ported_task_trains_and_lives_the_life_of_the_gymnasium_class(folder):
    """coming-from-gymnasium-and-sb3.md"""
    said = run_commands([script("compare.py")], folder)
    steps, difference = re.fullmatch(r"(\d+) steps, difference (\S+)\n", said).groups()
    assert int(steps) == 200
    assert float(difference) < 1e-5
    output = run_commands(blocks(PAGE), folder)
    assert "./pole: 0 errors, 0 warnings" in output
    assert success_rate(output) > 0.9


@pytest.mark.slow
def test_the_script_that_one_has_trains_and_its_policy_is_brought_over(folder):
    over = Block("sh", None, "rlcli check ./pole --only names\nrlcli import sb3 pole.zip --task ./pole\n")
    output = run_commands([script("train_sb3.py"), over], folder)
    assert (folder / output.split()[-1] / "checkpoints").is_dir()
