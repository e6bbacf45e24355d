"""Conversion of a failed import into an error with the pip command that installs the missing package.

rlcli's entry point (`rlcli.cli.app`) converts every failed import of a dependency, required or optional, in this way.
"""

import re
from importlib import metadata

from rlcli.errors import DependencyError, install_hint
from rlcli.registry import OWN


def missing_dependency(error: BaseException) -> DependencyError | None:
    """Return the error for a missing dependency of rlcli, with its pip command; None for other exceptions."""
    module = error.name if isinstance(error, ModuleNotFoundError) else None
    if module is None:
        return None
    distribution = _DISTRIBUTIONS.get(module, module.lower().replace("_", "-"))
    needed = [line for line in metadata.requires(OWN) or [] if re.split(r"[^\w.-]", line)[0].lower() == distribution]
    if not needed:
        return None
    extras = [match[1] for line in needed if (match := re.search(r"extra == .(\w+)", line))]
    extra = next((extra for extra in extras if extra not in ("all", "dev")), "all")
    hint = install_hint(f"{OWN}[{extra}]" if len(extras) == len(needed) else distribution)
    return DependencyError(f"{distribution} is not installed", hint=hint)


_DISTRIBUTIONS = {"yaml": "pyyaml", "warp": "warp-lang", "mlflow": "mlflow-skinny"}
"""Name of an imported module -> name of the package that pip installs, where the two differ."""
