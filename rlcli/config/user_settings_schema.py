"""Schema of the user's settings file: folder of runs, loggers, viewer, verbosity, colours, plugins.

`rlcli.config.user_settings` validates the file with this schema.
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from rlcli.config.schema import StrictModel


def _require_no_null(text: str) -> str:
    if "\0" in text:
        raise ValueError("the text has a null character; remove it")
    return text


Text = Annotated[str, Field(min_length=1), AfterValidator(_require_no_null)]
Loggers = Annotated[list[Literal["tensorboard", "wandb", "mlflow", "trackio", "none"]], Field(min_length=1)]


class UserSettings(StrictModel):
    """Settings of the command line. Every key is optional."""

    runs_dir: Text | None = None
    """The folder for runs, as with RLCLI_RUNS_DIR and `--runs-dir`; `~` is your home folder. Default: the folder `runs`
    in the current folder."""
    loggers: Loggers | None = None
    """Loggers of new trainings, as with `--logger`. Default: TensorBoard, if it is installed."""
    viewer: Literal["auto", "native", "web", "none"] = "auto"
    """Viewer that `play` opens without `--viewer`. With `--json` or a video file, `play` opens no viewer."""
    verbosity: Literal["quiet", "normal", "verbose"] = "normal"
    """quiet and verbose have the effect of `--quiet` and `-v` for every command."""
    color: Literal["auto", "always", "never"] = "auto"
    """auto: colours on a terminal; always: as with FORCE_COLOR; never: as with NO_COLOR."""
    plugins: list[Text] | None = None
    """Distributions whose tasks and trainers are used, as with RLCLI_PLUGINS; an empty list: only the built-in tasks
    and trainers. Default: all installed distributions."""
