"""Write `rlcli_isaaclab/names.json`: the functions and classes that each module of Isaac Lab defines.

The files are parsed, not imported.

Usage: python names.py FOLDER, where FOLDER is Isaac Lab's `source`.
"""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path
from typing import Any

PACKAGES = ("isaaclab", "isaaclab_rl", "isaaclab_contrib", "isaaclab_mimic", "isaaclab_tasks", "isaaclab_assets")
KINDS = {ast.ClassDef: "class", ast.FunctionDef: "function"}


def main(source: Path) -> None:
    """Write the names of all modules below the folder `source` to `names.json`."""
    table: dict[str, dict[str, Any]] = {}
    for package in PACKAGES:
        root = source / package / package
        for file in sorted(root.rglob("*.py")):
            parts = (package, *file.relative_to(root).with_suffix("").parts)
            if package == "isaaclab_tasks" and "utils" not in parts and "mdp" not in parts:
                names = {}
            else:
                names = dict(sorted(names_of(ast.parse(file.read_text(encoding="utf-8"))).items()))
            table[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = names
    target = Path(__file__).parent.parent / "rlcli_isaaclab" / "names.json"
    rows = [f"{json.dumps(module)}: {json.dumps(names)}" for module, names in sorted(table.items())]
    target.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


def names_of(tree: ast.Module) -> dict[str, Any]:
    """Return the names that a module defines.

    The value of a name is "function", "class" or "value"; for a configuration class it is its `settings`.
    """
    found: dict[str, Any] = {}
    for node in tree.body:
        for kind, word in KINDS.items():
            if isinstance(node, kind) and not node.name.startswith("__"):
                is_settings = isinstance(node, ast.ClassDef) and node.name.endswith("Cfg")
                found[node.name] = settings(node) if is_settings else word
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        for target in targets:
            if isinstance(target, ast.Name) and not target.id.startswith("_"):
                found[target.id] = "value"
    return found


def settings(node: ast.ClassDef) -> dict[str, Any]:
    """Return bases, fields (name -> default) and nested classes of a configuration class.

    A default that is not a literal is None.
    """
    fields: dict[str, Any] = {}
    nested: dict[str, Any] = {}
    for item in node.body:
        if isinstance(item, ast.ClassDef):
            nested[item.name] = settings(item)
        target = item.targets[0] if isinstance(item, ast.Assign) else getattr(item, "target", None)
        if isinstance(target, ast.Name) and not target.id.startswith("_"):
            fields[target.id] = literal(item.value)
    found: dict[str, Any] = {"bases": [ast.unparse(base) for base in node.bases]}
    return found | {key: value for key, value in (("fields", fields), ("nested", nested)) if value}


def literal(node: ast.expr | None) -> Any:
    """Return the value of a literal if JSON can hold it, otherwise None."""
    try:
        value = ast.literal_eval(node) if node is not None else None
        json.dumps(value, allow_nan=False)
    except (ValueError, TypeError, SyntaxError):
        return None
    return value


if __name__ == "__main__":
    main(Path(sys.argv[1]))
