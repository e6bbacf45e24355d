"""Templates of the exported programs.

They are ordinary Python files and import nothing of rlcli, because they are copied to machines without it.
"""
