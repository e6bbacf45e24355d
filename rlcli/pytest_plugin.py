"""Pytest fixture `rlcli_check`, which runs `rlcli check` on a task in a test. Pytest finds the fixture by itself.

```python
def test_the_contract(rlcli_check):
    rlcli_check("acrobot")
```
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rlcli.testing import Finding


@pytest.fixture
def rlcli_check() -> Callable[..., list[Finding]]:
    """Return a function that runs the checks of `rlcli check` on a task.

    The function has the arguments of `rlcli.testing.check_task`: the name or folder of a task, `agent`, `overrides`
    and `only`. If a check finds errors, the test fails; otherwise the function returns the warnings.
    """

    def check(
        task: str | Path, *, agent: str | None = None, overrides: Sequence[str] = (), only: Sequence[str] = ()
    ) -> list[Finding]:
        __tracebackhide__ = True
        from rlcli.testing import check_task

        findings = check_task(task, agent=agent, overrides=overrides, only=only)
        errors = [str(finding) for finding in findings if finding.severity == "error"]
        if errors:
            pytest.fail("\n".join([f"task '{task}' fails `rlcli check`:", *errors]), pytrace=False)
        return findings

    return check
