"""Fixtures for all test suites: tests write no state outside of their folders."""

import os
import signal
from dataclasses import fields, replace

import pytest

from rlcli.cli.ui.console import console

# Background jobs ignore SIGINT, nohup ignores SIGHUP, and child processes of the tests would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def own_state(tmp_path_factory):
    """Keep trusted tasks and user settings in a folder of the tests."""
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
    """Restore the console's settings after each test."""
    before = replace(console)
    yield
    for field in fields(console):
        setattr(console, field.name, getattr(before, field.name))
