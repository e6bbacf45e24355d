"""The arm of several tasks: seven joints and a gripper with two fingers. Numbers and their sources: docs/zoo/reach.md."""
