"""Views of a `VecEnv` for other libraries."""
