"""Table of the errors of a trajectory: what each is called, its unit, how it is printed, and which end is better."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dvo.metrics.metrics import Metrics


@dataclass(frozen=True)
class Metric:
    """One row.

    Attributes:
        name: by which files and options know it.
        title: in tables.
        unit: of the value that is shown.
        digits: after the point.
        find: value, from what is measured; nan where it has no meaning.
        better: ``low`` or ``high``; empty for a quantity that is neither good nor bad.
        factor: of the value that is shown, 100 for a share in percent.
        over_runs: summary of several runs, ``median`` or ``mean``.

    Example:
        >>> Metric("ate_percent", "ATE %", "%", 2, lambda found: found.ate_percent).text(1.234)
        '1.23'
    """

    name: str
    title: str
    unit: str
    digits: int
    find: Callable[[Any], float]
    better: Literal["low", "high", ""] = "low"
    factor: float = 1.0
    over_runs: Literal["median", "mean"] = "median"

    def text(self, value: float) -> str:
        """Value as it is shown, without the unit.

        Args:
            value: as ``find`` gives it.
        """
        return f"{self.factor * value:.{self.digits}f}"


def _field(name: str) -> Callable[[Metrics], float]:
    """Value of an attribute of :class:`dvo.metrics.Metrics`."""
    return lambda found: float(getattr(found, name))


ERRORS = (
    Metric("ate_percent", "ATE %", "%", 2, _field("ate_percent")),
    Metric("ate_rmse", "ATE m", "m", 3, _field("ate_rmse")),
    Metric("rpe_trans", "RPE m", "m", 4, _field("rpe_trans")),
    Metric("rpe_rot_deg", "RPE °", "°", 3, _field("rpe_rot_deg")),
    Metric("rotation_error_ratio", "rot. error / rot.", "", 2, _field("rotation_error_ratio")),
    Metric("scale_drift", "scale drift", "", 2, _field("scale_drift"), ""),
    Metric("rpe_trans_rmse", "RPE m (RMS)", "m", 4, _field("rpe_trans_rmse")),
    Metric("rpe_rot_deg_rmse", "RPE ° (RMS)", "°", 3, _field("rpe_rot_deg_rmse")),
    Metric("path_length", "path m", "m", 2, _field("path_length"), ""),
)
"""Those of :class:`dvo.metrics.Metrics`; ``find`` takes one of these."""
SHOWN = "ate_percent", "ate_rmse", "rpe_trans", "rpe_rot_deg"
"""Names of those that a run prints."""


def shown(found: Metrics | dict[str, Any], names: Sequence[str] = SHOWN) -> list[tuple[Metric, str]]:
    """Errors that a run prints, of those that are defined, with their texts to three significant digits.

    Args:
        found: errors, or as run.json has them.
        names: of the errors.
    """
    values = found if isinstance(found, dict) else vars(found)
    rows = [metric for metric in ERRORS if metric.name in names]
    known = [(row, values.get(row.name)) for row in rows]
    return [(row, f"{row.factor * value:.3g}") for row, value in known if value is not None and math.isfinite(value)]
