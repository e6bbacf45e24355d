"""Copies of source folders, in which packages are built without leaving files in the repository."""

import shutil
from pathlib import Path

NOT_COPIED = (".git", ".venv", "__pycache__", ".*_cache", ".hypothesis", "_build")


def copy_sources(source, target, *not_copied):
    """Copy a folder without its version control, caches, runs and folders of the given names."""
    ignored = shutil.ignore_patterns(*NOT_COPIED, *not_copied)

    def ignore(folder, names):
        own_runs = {"runs"} if Path(folder) == Path(source) else set()  # not the package rlcli.runs
        return ignored(folder, names) | own_runs & {*names}

    shutil.copytree(source, target, ignore=ignore)
