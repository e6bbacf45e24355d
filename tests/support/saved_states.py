"""A small saved state, and manipulations of it."""

import hashlib
import json
from pathlib import Path

import torch

from rlcli.rl.policy import Policy, PolicySpec
from rlcli.rl.trainer import TrainerState

SPEC = {"observation_size": 3, "action_size": 2, "hidden": [4], "activation": "elu", "action_bound": 1.0}


def state_of(seed=0):
    torch.manual_seed(seed)
    policy = Policy(PolicySpec.model_validate(SPEC))
    tensors = {"policy": policy.state_dict(), "trainer": {"critic.w": torch.randn(4)}}
    rest = {"env": {"x": torch.randn(3)}, "rng": {"torch": torch.zeros(4)}}
    return TrainerState({**tensors, **rest}, {"policy": policy.spec.model_dump(), "iteration": 1})


def rehash(folder: Path, *names: str) -> None:
    """Update the manifest to match changed files, as an attacker would."""
    manifest = json.loads((folder / "manifest.json").read_text())
    for name in names:
        data = (folder / name).read_bytes()
        manifest["files"][name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(manifest))
