"""Schema of a task: every key of a `task.yaml` with its meaning, unit, range and default.

The classes are pydantic models; one module describes one part, such as the scene.
"""

from rlcli.config.schema.agent import *
from rlcli.config.schema.base import *
from rlcli.config.schema.scene import *
from rlcli.config.schema.sensors import *
from rlcli.config.schema.task import *
from rlcli.config.schema.terms import *
from rlcli.config.schema.terrain import *
