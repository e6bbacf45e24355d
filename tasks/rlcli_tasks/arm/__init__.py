"""Model of the arm that several tasks use: seven joints and a gripper with two fingers.

Parameters and their sources: docs/reference/zoo/reach.md.
"""
