"""Exported policies: their files, their metadata, and the check in plain MuJoCo."""
