"""Reader of Isaac Lab's curriculum terms that change a setting of the task during training."""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rlcli_isaaclab.curricula import ChangedSetting
from rlcli_isaaclab.settings import Node, Report

if TYPE_CHECKING:
    from rlcli_isaaclab.term_reader import TermReader


def read_changed_setting(reader: TermReader, function: type, node: Node, params: Node) -> dict[str, Any]:
    """Return a curriculum term that changes a setting during training with the user's function.

    Args:
        reader: reader of the task's terms.
        function: Isaac Lab's class `modify_env_param`, or a subclass.
        node: settings of the term.
        params: settings of its parameters.
    """
    from rlcli_isaaclab.terms import SettingTerm

    address = str(params.require("address"))
    values = {key: params.get(key) for key in ("modify_fn", "modify_params")}
    setting = None
    with contextlib.suppress(KeyError, AttributeError, TypeError, IndexError, ValueError):
        setting = ChangedSetting(reader.data, address, functools.partial(_translate_again, reader))
    if setting is None or not (setting.addresses or setting.is_own):
        hint = "use the address of a number: SECTION.TERM.params.KEY, rewards.TERM.weight, commands.TERM.ranges.KEY"
        what = f"the address '{address}' names no setting that rlcli can change during training"
        reader.report.problem((*params.key, "address"), what, hint)
        return {"func": "stages", "address": "", "steps": [], "values": []}
    return {"func": SettingTerm(function, setting, values, reader.context), **dict(setting.addresses)}


def _translate_again(
    reader: TermReader, section: str, term: list[str], settings: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Translate one term of Isaac Lab with changed settings, to find out which settings of rlcli change.

    Args:
        reader: reader of the task's terms; it is not changed.
        section: section of the term.
        term: name of the term; for an observation, names of the group and the term.
        settings: the changed settings.

    Yields:
        Address (such as `rewards.alive`) and settings of each term of rlcli that replaces the term.
    """
    reader = copy.copy(reader)
    reader.report, reader.stubs = Report(), {}
    node = Node(settings, (section, *term), reader.report)
    if section in ("commands", "actions"):
        read = reader.read_command if section == "commands" else reader.read_action
        yield f"{section}.{term[0]}", read(node)
    elif section == "observations":
        yield ".".join((section, *term)), reader.read_term(section, node)
    else:
        for name, config in reader.read_terms(section, term[0], node):
            yield f"{section}.{name}", config
