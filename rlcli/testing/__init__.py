"""Checks and linter for authors of tasks; both run the task.

The checks test the rules for shapes, seeds, resets and so on that every task must keep (its contract). The linter looks
for properties that make learning hard. `rlcli check`, `rlcli lint` and the pytest plugin call this package.

```python
from rlcli.testing import check_task

for finding in check_task("acrobot"):
    print(finding)
```
"""

from rlcli.testing.checks import CHECKS, check_task, record_layout
from rlcli.testing.findings import Finding
from rlcli.testing.lint import lint_task
from rlcli.testing.lint_rules import RULES
from rlcli.testing.remarks import Remark

__all__ = ["CHECKS", "RULES", "Finding", "Remark", "check_task", "lint_task", "record_layout"]
