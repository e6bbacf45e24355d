"""Errors of the checks for NaN and infinity."""

import pytest
import torch

from rlcli.errors import DivergedError
from rlcli.rl.nan_check import LEARNER_HINT, require_finite


def test_first_tensor_that_is_not_finite_is_named_with_index_and_hint():
    values = torch.zeros(2, 3)
    values[1, 2] = torch.inf
    named = [("the action", torch.zeros(2)), ("the value", values), ("the loss", values)]
    with pytest.raises(DivergedError, match=r"the value is not finite .*step 1, environment 2.* iteration 4") as caught:
        require_finite(named, 4, ("step", "environment"))
    assert caught.value.hint == LEARNER_HINT
    with pytest.raises(DivergedError) as caught:
        require_finite(named, 4, hint="lower sigma")
    assert caught.value.hint == "lower sigma"
