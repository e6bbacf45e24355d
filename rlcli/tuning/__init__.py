"""Commands that run many trainings: several seeds, sweeps (hyperparameter search), benchmarks of speed."""
