"""Conversion of the key `success` in runs of earlier versions of rlcli to the present form.

Earlier the key had one function, `{func: ...}`; now it has a mapping of named conditions, `{NAME: {func: ...}}`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.config.strict_yaml import Document, load

_TABLE = Path(__file__).with_suffix(".yaml")


def upgraded(document: Document, file: Path) -> Document:
    """Return a parsed file; if it is the `config.yaml` of a run, convert its `success` to the present form."""
    success = document.data.get("success")
    if file.name == "config.yaml" and isinstance(success, dict) and isinstance(success.get("func"), str):
        document.data["success"] = _named_conditions(success)
    return document


def _named_conditions(success: Mapping[str, Any]) -> dict[str, Any]:
    """Return the named conditions, `{NAME: {func: ...}}`, that equal `success` in its earlier form, `{func: ...}`."""
    table = load(_TABLE.read_bytes()).data
    bounds = table["conditions"].get(str(success["func"]), {})
    if not bounds:
        return {"success": dict(success)}  # a function of the task, which returns a boolean
    old_keys = {"func", "hold_s", *(key for _, _, key in bounds.values())}
    others = {key: value for key, value in success.items() if key not in old_keys}
    hold = {"hold_s": success["hold_s"]} if "hold_s" in success else {}
    conditions = {}
    for name, (term, bound, key) in bounds.items():
        if success.get(key) is not None:
            own = {k: v for k, v in others.items() if k in table["own_keys"].get(term, others)}
            conditions[name] = {"func": term, **own, bound: success[key], **hold}
    return conditions
