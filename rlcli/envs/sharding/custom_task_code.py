"""Code of tasks that may depend on the number of worker processes."""

from __future__ import annotations

from rlcli.config.load import Resolved

_TESTED = ("rlcli", "rlcli-gymnasium", "rlcli-menagerie")
"""Distributions whose tasks are tested with several workers."""


def has_untested_code(resolved: Resolved) -> bool:
    """Return whether a task has code of its own that is not tested with several workers."""
    has_own_code = resolved.source.task is not None or bool(resolved.vocabulary.own)
    return has_own_code and resolved.source.distribution not in _TESTED
