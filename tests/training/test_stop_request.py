"""What a signal before training becomes, whatever the code that it met made of it."""

from __future__ import annotations

import signal

import pytest

from rlcli.errors import Stopped
from rlcli.training.signals import StopRequest


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), ImportError("initialization failed"), None])
def test_a_signal_ends_what_comes_before_training(number, code, error):
    stop = StopRequest()

    def interrupted():
        with stop.before_training(interruptible=False):
            stop.signal = number
            if error is not None:
                raise error

    with pytest.raises(Stopped, match="before training began") as stopped:
        interrupted()
    assert stopped.value.exit_code == code


def test_without_a_signal_an_error_stays_what_it_is():
    with pytest.raises(ImportError, match="no such module"), StopRequest().before_training():
        raise ImportError("no such module")
