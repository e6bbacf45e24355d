"""Build a task's scene (a MuJoCo model of robots, objects, sensors and terrain), and read and set its state."""
