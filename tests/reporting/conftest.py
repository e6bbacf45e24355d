"""Fixtures of the tests in this folder."""

from support.command_line import cli, coin, empty_folder, start
from support.torch_threads import _one_torch_thread
