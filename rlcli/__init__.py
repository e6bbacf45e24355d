"""rlcli: train, play, evaluate and export robot-control policies in MuJoCo. Importing it does nothing else."""

__version__ = "0.1.0"
