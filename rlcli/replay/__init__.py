"""Recordings of evaluations, of failures in a training and of diverged simulations, and replays of them."""
