"""Result of `export --verify`: differences between an exported policy in plain MuJoCo and the run's evaluation."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.deploy.export import TOLERANCE

CLOSE = 1e-4
"""Largest accepted difference of an observation or a control, relative to max(1, |value|)."""
RETURN = 0.02
"""Largest accepted difference of the mean return, relative to the evaluation's mean |return|."""


@dataclass(slots=True)
class ClosedLoopResult:
    """Result of the check of an exported policy in plain MuJoCo against the environment.

    A difference between two values is divided by max(1, |value|).
    """

    model: Path
    program: Path
    differing: list[str]
    """Keys of the metadata whose values differ from the task's."""
    episodes: int
    steps: int
    differences: dict[str, float]
    """Largest difference of `action`, `observation` and `control`."""
    evaluation_return: float
    """Mean return of the run's evaluation."""
    plain_return: float
    """Mean return in plain MuJoCo."""
    scale: float
    """Mean absolute return of the evaluation's episodes, by which differences of returns are divided."""
    by_metadata: list[str]
    """Names of the terms that the generated program computed from formulas in the metadata."""
    by_task: list[str]
    """Names of terms without a formula, and of forces; the task's code computed them for the states of plain MuJoCo."""
    synchronized_return: float | None = None
    """Mean return with states re-synchronised after every step; None: not measured.

    This return is measured only if `plain_return` is too far from `evaluation_return` and all other checks pass.
    """
    disagreeing_steps: int = 0
    """Re-synchronised steps after which the states of the two sides differed by more than rounding."""

    @property
    def return_difference(self) -> float:
        """Relative difference of the mean returns in plain MuJoCo and in the evaluation."""
        return self._relative(self.plain_return)

    def rows(self) -> list[tuple[str, float, float, bool]]:
        """Return one row for each check: (name, value found, largest value allowed, whether the check passed)."""
        synchronized = self.synchronized_return
        returns = self.return_difference if synchronized is None else self._relative(synchronized)
        suffix = "" if synchronized is None else " (re-synchronised)"
        checks = (
            ("description: entries that differ from the task", float(len(self.differing)), 0.0),
            ("action: exported file - policy", self.differences["action"], TOLERANCE),
            ("observation: formulas - task", self.differences["observation"], CLOSE),
            ("control: formulas - task", self.differences["control"], CLOSE),
            (f"return: plain MuJoCo - evaluation{suffix}", returns, RETURN),
        )
        return [(name, found, allowed, found <= allowed) for name, found, allowed in checks]

    @property
    def holds(self) -> bool:
        """Whether every check passed. A NaN fails its check."""
        return all(row[3] for row in self.rows())

    def record(self) -> dict[str, Any]:
        """Return the result as data for JSON."""
        synchronized = None
        if self.synchronized_return is not None:
            synchronized = {"return": self.synchronized_return, "parted": self.disagreeing_steps}
        return {
            "passed": self.holds,
            "episodes": self.episodes,
            "steps": self.steps,
            "model": str(self.model),
            "program": str(self.program),
            "return": self.plain_return,
            "evaluation_return": self.evaluation_return,
            "side_by_side": synchronized,
            "checks": [dict(zip(("check", "found", "allowed", "passed"), row, strict=True)) for row in self.rows()],
            "unlike": self.differing,
            "closed_by_metadata": self.by_metadata,
            "closed_by_task": self.by_task,
        }

    def _relative(self, mean_return: float) -> float:
        return abs(mean_return - self.evaluation_return) / max(self.scale, 1e-9)
