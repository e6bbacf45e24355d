"""Interface for plugins with a trainer (a learning algorithm): the class `TrainerSpec`.

An entry point of the group `rlcli.trainers` names an object of this class.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rlcli.task import API_VERSION, require_field_types


@dataclass(frozen=True, slots=True)
class TrainerSpec:
    """A trainer of a plugin. An entry point of the group `rlcli.trainers` names an object of this class.

    The module that defines the object must be cheap to import.

    Attributes:
        summary: one line that describes the trainer.
        algorithms: name of an algorithm -> `module:Model`, the pydantic model of the algorithm's settings (a subclass
            of `AgentConfig`). If the `algorithm` of an agent is a mapping, its key `class_name` names the algorithm;
            without that key, the first algorithm is used.
        trainer: `module:Class` of a `Trainer`, called as `Class(env, config, seed=, device=, torch_threads=)`.
        refused: name of an algorithm that the trainer's library has, but this trainer cannot run -> the reason.
        parallel: whether several processes can train one policy (`rlcli.rl.distributed`).
        gpu: whether the trainer can train on a GPU, with all tensors on the GPU; if not, `--device auto` is the CPU.
        api: the version of this interface, `rlcli.task.API_VERSION`, that the trainer was written for.
    """

    summary: str
    algorithms: Mapping[str, str]
    trainer: str
    refused: Mapping[str, str] = field(default_factory=dict)
    parallel: bool = False
    gpu: bool = False
    api: int = API_VERSION

    def __post_init__(self) -> None:
        require_field_types(self)
