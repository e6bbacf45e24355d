"""Modules that run many trainings: with several seeds, in a sweep (hyperparameter search), or to measure speed."""
