"""The tasks of a checkout of OmniIsaacGymEnvs, whose folder the environment variable RLCLI_OIGE names."""

import os
import re
from pathlib import Path

import all_tasks
import pytest
import stand_ins

import rlcli

PAGE = Path(rlcli.__file__).parents[1] / "docs" / "guides" / "omniisaacgymenvs.md"
ROW = re.compile(r"^\| (\w+) \| (yes|no) \| (yes|no) \| (yes|no) \| (yes|no) \|", re.MULTILINE)
TABLE = {name: [cell == "yes" for cell in cells] for name, *cells in ROW.findall(PAGE.read_text(encoding="utf-8"))}


def test_page_lists_twenty_tasks():
    assert len(TABLE) == 20
    assert sum(all(cells) for cells in TABLE.values()) == 16


@pytest.mark.slow
@pytest.mark.skipif("RLCLI_OIGE" not in os.environ, reason="RLCLI_OIGE names no checkout of OmniIsaacGymEnvs")
@pytest.mark.parametrize("name", sorted(TABLE))
def test_task_gets_as_far_as_the_page_says(tmp_path, name):
    checkout = Path(os.environ["RLCLI_OIGE"]).resolve()
    row = all_tasks.examine(name, checkout, tmp_path, stand_ins.write(tmp_path))
    assert [row[key] for key in ("validates", "builds", "steps", "trains")] == TABLE[name], row["reason"]
    if not row["trains"]:
        assert re.match(rf"{re.escape(str(checkout))}/\S+\.py:\d+: ", str(row["reason"]))
