"""Scene of a task: MJCF, entities, actuators, sensors and terrain."""
