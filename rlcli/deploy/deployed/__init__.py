"""Templates of the exported programs. They are ordinary Python files and import nothing of rlcli."""
