"""Fixtures and options of all tests."""

from support.own_session import own_console, own_state

__all__ = ["own_console", "own_state"]
