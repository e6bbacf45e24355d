"""Fixtures that the tests share with those of rlcli."""

from support.own_session import own_console, own_state

__all__ = ["own_console", "own_state"]
