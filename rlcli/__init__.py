"""rlcli: train, play, evaluate and export robot-control policies in MuJoCo. `rlcli.api` is the Python interface."""

__version__ = "0.1.0"
