"""Fixtures that every suite of the repository shares: nothing is noted in the folders of whoever runs the tests."""

import os
import signal
from dataclasses import fields, replace

import pytest

from rlcli.cli.ui.console import console

# A shell's background job ignores the one, what nohup starts the other: what the tests start would inherit it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def own_state(tmp_path_factory):
    """Tasks that the tests use are noted in a folder of the tests, and nobody's preferences are followed."""
    own = {"RLCLI_STATE_DIR": str(tmp_path_factory.mktemp("state")), "RLCLI_SETTINGS": "none"}
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    yield
    for name, value in before.items():
        if value is None:
            del os.environ[name]
        else:
            os.environ[name] = value


@pytest.fixture(autouse=True)
def own_console():
    """What a command was told to print ends with the test that ran it."""
    before = replace(console)
    yield
    for field in fields(console):
        setattr(console, field.name, getattr(before, field.name))
