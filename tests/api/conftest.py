"""Fixtures of the tests in this folder."""

from support.command_line import cli, empty_folder
from support.torch_threads import _one_torch_thread
