"""The built-in tasks of rlcli: one folder with model, configurations and shipped policies for each robot."""
