"""Fixtures of the tests in this folder."""

from support.command_line import empty_folder, only_run, start
from support.scheduled_task import make, scheduled
from support.torch_threads import _one_torch_thread
