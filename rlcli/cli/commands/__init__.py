"""Commands of `rlcli`, one module for each.

A module declares the options of its command, calls the library, and prints the result.
"""
