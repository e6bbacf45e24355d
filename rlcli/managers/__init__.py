"""Managers of manager-based tasks. Each runs the terms of one section of the YAML."""
