"""Fixtures of the fault tests."""

import pytest
from support.child_processes import warm_parent


@pytest.fixture(scope="session")
def child():
    """Return a launcher of commands in processes that are forked from one initialised parent."""
    with warm_parent() as start:
        yield start
