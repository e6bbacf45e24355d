"""Translation of the rl_games train YAMLs of OmniIsaacGymEnvs to settings of the trainer `ppo`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rlcli.config.layers import Origin, document_origins
from rlcli.config.strict_yaml import Document, Path
from rlcli.errors import ConfigError
from rlcli.formats import Note
from rlcli.rl.ppo.rl_games_file import RlGamesReader
from rlcli_oige.hydra_interpolation import evaluate
from rlcli_oige.yaml_translator import YamlTranslator


@dataclass(slots=True)
class Agent:
    """Settings of the trainer `ppo`, and the position of each setting in the train YAML."""

    data: dict[str, Any]
    """Settings by key."""
    origin: Callable[[Path], Origin]
    """Function from the path of a setting to its file and line in the train YAML."""
    notes: list[Note]
    """How each key of the train YAML was translated."""

    def origin_at(self, at: Path) -> Callable[[Path], Origin]:
        """Return a function from a path in the task, below `at`, to file and line of the setting in the train YAML."""
        return lambda path: self.origin(path[len(at) :])


def translate(document: Document, label: str, root: Mapping[str, Any]) -> Agent:
    """Return settings of the trainer `ppo` that train as rl_games does with this file.

    Args:
        document: the train YAML.
        label: name of the file in messages.
        root: settings that interpolations in the train YAML may refer to, including the evaluated task.

    Raises:
        ConfigError: with every unknown key and every wrong value.
    """
    return _Translator(document, label).run(root)


class _Translator(YamlTranslator):
    def run(self, root: Mapping[str, Any]) -> Agent:
        train, errors = evaluate({**root, "train": self.document.data}, ("train",))
        for error in errors:
            self.problem(error.path[1:], str(error), error.hint)
        for key in train:
            if key != "params":
                self.problem((key,), f"unknown key '{key}'", "keys: params")
        RlGamesReader(self, is_strict=True).read(train.get("params"))
        if self.problems:
            raise ConfigError(self.problems)
        origin = document_origins(self.document, self.label, "task")

        def origin_of(path: Path) -> Origin:
            for length in range(len(path), 0, -1):
                if path[:length] in self.sources:
                    return origin(self.sources[path[:length]])
            return origin(("params",))

        return Agent(self.data, origin_of, self.notes)
