"""Fixtures of the tests in this folder."""

from support.installed_plugins import broken_plugins, cli, command, plugins, spec
