"""Distance of the last pose from the truth, without any alignment, as a metric of an evaluation."""

import math

import numpy as np

from dvo.metrics.table import Metric
from eval.scoring.metric_table import Scored


def end_error(run: Scored) -> float:
    """Metres; nan without a pose or a truth."""
    if run.reference is None or not run.segments:
        return math.nan
    last = run.segments[-1].trajectory.positions[-1]
    return float(np.linalg.norm(last - run.reference.positions[-1]))


END_ERROR = Metric("end_error", "end error m", "m", 3, end_error)
