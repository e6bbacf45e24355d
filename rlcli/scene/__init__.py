"""Modules that build a task's scene (a MuJoCo model of robots, objects, sensors and terrain) and read its state."""
