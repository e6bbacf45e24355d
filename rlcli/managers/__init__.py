"""Managers of manager-based tasks. Each manager calls the terms (functions, classes) of one section of the YAML."""
