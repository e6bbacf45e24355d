"""Attacks that once broke rlcli end with a message, in little time and memory."""

import os

import pytest
from support.fault_sizes import chosen
from support.known_attacks import ATTACKS, read_only, run

pytestmark = [pytest.mark.slow, pytest.mark.processes]


@pytest.mark.parametrize("name", chosen(list(ATTACKS), 6))
def test_attack_ends_with_a_message(name, tmp_path):
    if ATTACKS[name].prepare is read_only and os.geteuid():
        pytest.skip("only root can mount a folder")
    ended, wrong = run(ATTACKS[name], tmp_path)
    assert not wrong, ended.printed[-2000:]
