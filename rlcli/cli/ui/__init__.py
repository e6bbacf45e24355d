"""Modules that several commands share: terminal output, tables, options and shell completion."""
