"""PPO: configuration, collector, learner, networks and the trainer."""
