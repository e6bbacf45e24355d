"""Files with recorded steps (of evaluations, of failures in a training, of diverged simulations), and their replay."""
