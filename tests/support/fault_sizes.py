"""Number of cases in tests with many: a sample in `make test`, all in `make test-all` and `make test-faults`.

`make test-faults-long` runs still more.
"""

import os
from collections.abc import Sequence
from typing import Any

SIZE = os.environ.get("RLCLI_TEST_SIZE", "sample")
assert SIZE in ("sample", "full", "long"), f"RLCLI_TEST_SIZE is '{SIZE}': sample, full or long"


def amount(sample: int, full: int, long: int | None = None) -> int:
    """Return the number of cases for the chosen size."""
    return {"sample": sample, "full": full, "long": full if long is None else long}[SIZE]


def chosen(cases: Sequence[Any], sample: int) -> list[Any]:
    """Return all cases, or an evenly spread sample."""
    cases = list(cases)
    if SIZE != "sample" or sample >= len(cases):
        return cases
    return [cases[index * len(cases) // sample] for index in range(sample)]
