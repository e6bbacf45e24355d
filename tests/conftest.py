"""What all tests share."""

from support.own_session import own_console, own_state

__all__ = ["own_console", "own_state"]
