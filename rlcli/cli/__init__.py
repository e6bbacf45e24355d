"""The command line: one module for each command, `app` with main and exit codes, and `ui` for output and options."""
