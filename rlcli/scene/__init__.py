"""Scene of a task: the MuJoCo model of its robots and objects, with actuators, sensors and terrain, and their state."""
