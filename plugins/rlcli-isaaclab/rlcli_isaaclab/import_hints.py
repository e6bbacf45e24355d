"""Hints for failed imports in a task's file."""

from __future__ import annotations

import sys

from rlcli.errors import did_you_mean, listing


def import_hint(error: BaseException) -> str | None:
    """Return a hint for an import from Isaac Lab or Isaac Sim, or for a name that this package does not have."""
    module = getattr(error, "name", None) or ""
    top, _, rest = module.partition(".")
    if isinstance(error, ModuleNotFoundError):
        if top in _ISAAC_LAB:
            where = f"rlcli_isaaclab{f'.{rest}' if top == 'isaaclab' and rest else ''}"
            return f"import it from {where}: docs/guides/isaac-lab.md lists the lines"
        if top in _ISAAC_SIM:
            return f"'{top}' belongs to Isaac Sim: remove the import and the code that uses it"
        return None
    if isinstance(error, AttributeError):
        module = str(getattr(error.obj, "__name__", ""))
        known = dir(error.obj) if module.startswith("rlcli_isaaclab.") and module != "rlcli_isaaclab.mdp" else []
        if not known:
            return None
        return did_you_mean(str(error.name), known) or f"it has {listing([n for n in known if n[0].isupper()], 40)}"
    if not isinstance(error, ImportError) or not module.startswith("rlcli_isaaclab"):
        return None
    name = str(error).partition("'")[2].partition("'")[0]
    if name.removesuffix("Cfg") in _UNSUPPORTED:
        return _UNSUPPORTED[name.removesuffix("Cfg")]
    near = did_you_mean(name, dir(sys.modules[module]))
    return near or "docs/guides/isaac-lab.md and docs/reference/isaac-lab-terms.md list the names"


_ISAAC_LAB = ("isaaclab", "isaaclab_tasks", "isaaclab_assets", "isaaclab_rl", "isaaclab_contrib", "isaaclab_mimic")
_ISAAC_SIM = ("isaacsim", "omni", "pxr", "carb", "usdrt", "Semantics")
_UNSUPPORTED = {
    "DirectRLEnv": "write a DirectRLEnv as a direct task: docs/guides/isaac-lab.md, 'A DirectRLEnv'",
    "DirectMARLEnv": "rlcli has no multi-agent tasks",
    "ActionTerm": "write your own action as a class for rlcli: docs/guides/isaac-lab.md, 'What is what'",
    "AppLauncher": "there is no app to launch; instead of your scripts use `rlcli train`, `play` and `eval`",
    "SimulationContext": "rlcli steps the simulation: terms read its state from env.scene",
    "InteractiveScene": "rlcli builds the scene of your InteractiveSceneCfg: terms read it from env.scene",
}
"""Names of Isaac Lab without a counterpart (also with `Cfg` appended) -> what to do instead."""
