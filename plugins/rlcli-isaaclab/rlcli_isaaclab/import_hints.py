"""What to do about an import of a task's file that fails."""

from __future__ import annotations

import sys

from rlcli.errors import did_you_mean, listing


def import_hint(error: BaseException) -> str | None:
    """Return what to do about an import of Isaac Lab's or Isaac Sim's, or of a name that is missing here."""
    module = getattr(error, "name", None) or ""
    top, _, rest = module.partition(".")
    if isinstance(error, ModuleNotFoundError):
        if top in _ISAAC_LAB:
            where = f"rlcli_isaaclab{f'.{rest}' if top == 'isaaclab' and rest else ''}"
            return f"import it from {where}: docs/guides/isaac-lab.md lists the lines"
        return f"'{top}' is Isaac Sim's: take the import out, and what uses it" if top in _ISAAC_SIM else None
    if isinstance(error, AttributeError):
        module = str(getattr(error.obj, "__name__", ""))
        known = dir(error.obj) if module.startswith("rlcli_isaaclab.") and module != "rlcli_isaaclab.mdp" else []
        return (
            (did_you_mean(str(error.name), known) or f"it has {listing([n for n in known if n[0].isupper()], 40)}")
            if known
            else None
        )
    if not isinstance(error, ImportError) or not module.startswith("rlcli_isaaclab"):
        return None
    name = str(error).partition("'")[2].partition("'")[0]
    if name.removesuffix("Cfg") in _NOT_THERE:
        return _NOT_THERE[name.removesuffix("Cfg")]
    near = did_you_mean(name, dir(sys.modules[module]))
    return near or "docs/guides/isaac-lab.md and docs/reference/isaac-lab-terms.md say what there is"


_ISAAC_LAB = ("isaaclab", "isaaclab_tasks", "isaaclab_assets", "isaaclab_rl", "isaaclab_contrib", "isaaclab_mimic")
_ISAAC_SIM = ("isaacsim", "omni", "pxr", "carb", "usdrt", "Semantics")
_NOT_THERE = {
    "DirectRLEnv": "a DirectRLEnv becomes a direct task: docs/guides/isaac-lab.md, 'A DirectRLEnv'",
    "DirectMARLEnv": "rlcli has no tasks of several agents",
    "ActionTerm": "an action of your own is a class in rlcli's form: docs/guides/isaac-lab.md, 'What is what'",
    "AppLauncher": "there is no app to launch: rlcli train, play and eval take the place of your scripts",
    "SimulationContext": "rlcli steps the simulation: terms see it as env.scene",
    "InteractiveScene": "rlcli makes the scene of your InteractiveSceneCfg: terms see it as env.scene",
}
"""Names that Isaac Lab has and `rlcli_isaaclab` does not, also with `Cfg` behind them -> what to do."""
