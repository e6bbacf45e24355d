"""The scene of a task: MJCF, entities, actuators, sensors and terrain, as specification and as running objects."""
