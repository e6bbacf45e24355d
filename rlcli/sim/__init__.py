"""Simulation: from MJCF files to an engine that steps many copies of one model."""
