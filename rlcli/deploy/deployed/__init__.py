"""Templates of the exported programs.

The templates are ordinary Python files. They import nothing of rlcli, because they run on machines without rlcli.
"""
