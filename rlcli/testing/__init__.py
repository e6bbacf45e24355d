"""The contract kit, what every task must keep, and the linter, what a policy learns well from: both by running it.

For task authors, `rlcli check`, `rlcli lint` and pytest.

```python
from rlcli.testing import check_task

for finding in check_task("acrobot"):
    print(finding)
```
"""

from rlcli.testing.kit import CHECKS, check_task, record_layout
from rlcli.testing.lint import lint_task
from rlcli.testing.lint_rules import RULES, Remark
from rlcli.testing.task_under_test import Finding

__all__ = ["CHECKS", "RULES", "Finding", "Remark", "check_task", "lint_task", "record_layout"]
