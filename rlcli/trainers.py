"""What a trainer plugin exports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rlcli.task import API_VERSION


@dataclass(frozen=True, slots=True)
class TrainerSpec:
    """What an entry point of the group `rlcli.trainers` resolves to. Importing its module must be cheap.

    Attributes:
        summary: one line.
        algorithms: algorithm name -> `module:Model`, the pydantic model of its settings (an `AgentConfig`). An agent
            whose `algorithm` is a mapping names it by `class_name`, or means the first.
        trainer: `module:Class` of a `Trainer`, called as `Class(env, config, seed=, device=, torch_threads=)`.
        refused: algorithms that the library has and this trainer cannot run -> why.
        parallel: whether several processes can train one policy (`rlcli.rl.distributed`).
        gpu: whether it trains with everything on a GPU.
        api: the plugin interface that it was written for.
    """

    summary: str
    algorithms: Mapping[str, str]
    trainer: str
    refused: Mapping[str, str] = field(default_factory=dict)
    parallel: bool = False
    gpu: bool = False
    api: int = API_VERSION
