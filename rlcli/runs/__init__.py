"""Write, read and compare the folders of runs; a run is one training, with configuration, metrics and checkpoints."""
