"""Environments: the environment loop, and the two ways to write a task (workflows): manager-based and direct.

Trainers, evaluations and viewers step an environment through the protocol `Environment`.
"""
