"""Built-in tasks, one folder each."""
