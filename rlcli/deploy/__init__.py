"""Export of trained policies to files that run without rlcli, with metadata, and a check of them in plain MuJoCo."""
