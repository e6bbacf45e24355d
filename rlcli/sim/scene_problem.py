"""What the models of a scene do not fit of its configuration."""

from __future__ import annotations


class SceneProblem(ValueError):
    """Something in the scene's configuration that the models do not fit; `path` is its key."""

    def __init__(self, path: tuple[str, ...], message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.hint = hint
