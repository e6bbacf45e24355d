"""rl_games as a trainer of rlcli."""
