"""The arm of several tasks: seven joints and a gripper with two fingers. Numbers: docs/reference/zoo/reach.md."""
