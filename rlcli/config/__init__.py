"""Configuration of a task: strict YAML reader, schema, and how files and command line are merged and checked."""
