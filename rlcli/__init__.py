"""rlcli: train, play, evaluate and export robot-control policies in MuJoCo. The import has no side effects."""

__version__ = "0.1.0"
