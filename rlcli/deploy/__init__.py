"""Export of trained policies to files that run without rlcli, with metadata, and their check in plain MuJoCo."""
