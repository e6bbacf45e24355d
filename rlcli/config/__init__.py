"""Configuration: strict YAML, the schema of a task, and the layers that make up a resolved one."""
