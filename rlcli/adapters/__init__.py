"""Adapters of a `VecEnv` to the interfaces of other libraries."""
