"""Tests of a signal before training, which other code may turn into another error."""

from __future__ import annotations

import signal

import pytest

from rlcli.errors import Stopped
from rlcli.training.signals import StopRequest


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), ImportError("initialization failed"), None])
def test_signal_before_training_raises_stopped(number, code, error):
    stop = StopRequest()

    def interrupted():
        with stop.before_training(interruptible=False):
            stop.signal = number
            if error is not None:
                raise error

    with pytest.raises(Stopped, match="before training began") as stopped:
        interrupted()
    assert stopped.value.exit_code == code


def test_error_without_signal_is_not_changed():
    with pytest.raises(ImportError, match="no such module"), StopRequest().before_training():
        raise ImportError("no such module")
