"""Modules that read the configuration of a task: strict YAML reader, schema, merging of sources, and validation."""
