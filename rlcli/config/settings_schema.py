"""The keys of the user's settings file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rlcli.config.schema import StrictModel

Text = Annotated[str, Field(min_length=1)]
Loggers = Annotated[list[Literal["tensorboard", "wandb", "mlflow", "trackio", "none"]], Field(min_length=1)]


class UserSettings(StrictModel):
    """Preferences of the command line; every key may be left out."""

    runs_dir: Text | None = None
    """The runs folder, as RLCLI_RUNS_DIR and `--runs-dir` name it; `~` is your home. Default: runs, in the current
    folder."""
    loggers: Loggers | None = None
    """What new trainings log to, as `--logger` does. Default: TensorBoard, where it is installed."""
    viewer: Literal["auto", "native", "web", "none"] = "auto"
    """What `play` opens where it may choose: `--viewer` comes first, and nothing is opened for `--json` or a file."""
    verbosity: Literal["quiet", "normal", "verbose"] = "normal"
    """quiet and verbose are `--quiet` and `-v` of every command."""
    color: Literal["auto", "always", "never"] = "auto"
    """never and always are what NO_COLOR and FORCE_COLOR say; auto: colours on a terminal."""
    plugins: list[Text] | None = None
    """Distributions whose tasks and trainers are there, as RLCLI_PLUGINS names them; an empty list leaves the built-in
    ones. Default: every one that is installed."""
