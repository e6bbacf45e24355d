"""Fixtures of the tests in this folder."""

from support.command_line import cli, coin, empty_folder, environment, only_run, start, weights
