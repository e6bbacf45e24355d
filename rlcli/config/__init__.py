"""Configuration: the strict YAML reader, the schema of a task, and the layers of a resolved configuration."""
