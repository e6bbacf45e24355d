"""The contract kit: what every task must keep, found out by running it. For task authors, `rlcli check` and pytest.

```python
from rlcli.testing import check_task

for finding in check_task("acrobot"):
    print(finding)
```
"""

from rlcli.testing.kit import CHECKS, Finding, check_task

__all__ = ["CHECKS", "Finding", "check_task"]
