"""Code that runs many trainings: with several seeds, in a sweep (hyperparameter search), or to measure their speed."""
