"""Fixtures of the tests in this folder."""

from support.exported_runs import newest, runs
from support.torch_threads import _one_torch_thread
