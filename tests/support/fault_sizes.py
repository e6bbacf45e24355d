"""Number and seeds of cases in tests with many: a sample in `make test`, all in `make test-all` and `make test-faults`.

`make test-faults-long` runs still more. Both `test-faults` draw new cases every day; RLCLI_TEST_SEED=YYYYMMDD repeats
those of a day.
"""

import os
from collections.abc import Sequence
from typing import Any

SIZE = os.environ.get("RLCLI_TEST_SIZE", "sample")
assert SIZE in ("sample", "full", "long"), f"RLCLI_TEST_SIZE is '{SIZE}': sample, full or long"
FIRST_SEED = 1000 * int(os.environ.get("RLCLI_TEST_SEED", "0"))


def amount(sample: int, full: int, long: int | None = None) -> int:
    """Return the number of cases for the chosen size."""
    return {"sample": sample, "full": full, "long": full if long is None else long}[SIZE]


def seeds(sample: int, full: int, long: int | None = None) -> range:
    """Return the seeds of drawn cases, as many as `amount` says."""
    return range(FIRST_SEED, FIRST_SEED + amount(sample, full, long))


def chosen(cases: Sequence[Any], sample: int) -> list[Any]:
    """Return all cases, or an evenly spread sample."""
    cases = list(cases)
    if SIZE != "sample" or sample >= len(cases):
        return cases
    return [cases[index * len(cases) // sample] for index in range(sample)]
