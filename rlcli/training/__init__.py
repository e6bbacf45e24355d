"""One training, from a configuration or a saved run to the last checkpoint."""
