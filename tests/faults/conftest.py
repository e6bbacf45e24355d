"""What the suites of faults share."""

import pytest
from support.child_processes import warm_parent


@pytest.fixture(scope="session")
def child():
    """Starts commands as forked children of one warm parent."""
    with warm_parent() as start:
        yield start
