"""Fixtures of the tests in this folder."""

from support.command_line import cli, empty_folder, environment, only_run, start
