"""Export of trained policies to files that run without rlcli, and a check that these files work in plain MuJoCo."""
