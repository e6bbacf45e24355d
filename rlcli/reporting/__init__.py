"""Pages and pictures made from runs."""
