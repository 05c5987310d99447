"""Metrics of other packages beside those of the package."""

import math
from types import SimpleNamespace

import pytest

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.metrics.table import Metric
from eval.execution.predict import Prediction
from eval.scoring import metric_table

ENDS = Metric("ends", "ends m", "m", 3, lambda run: 0.0)


@pytest.mark.parametrize(
    ("name", "words"),
    [("segments", "segments: a metric of dvo has this name"), ("end", "end: the metric calls itself ends")],
)
def test_a_metric_has_one_name_of_its_own(name, words):
    foreign = Registry("metric", targets={name: f"{__name__}:ENDS"})
    with pytest.raises(DvoError, match=words):
        metric_table.all_metrics(foreign)


def test_a_metric_is_added_at_the_end():
    found = metric_table.all_metrics(Registry("metric", targets={"ends": f"{__name__}:ENDS"}))
    assert list(found)[-1] == "ends" and list(found)[:-1] == list(metric_table.all_metrics(Registry("metric")))


@pytest.mark.parametrize(
    ("verdict", "ate", "shape", "doubted", "silent"),
    [
        ("good", 1.9, math.nan, 0, 0),
        ("good", 2.1, math.nan, 0, 1),
        ("doubtful", 9.0, math.nan, 1, 0),
        ("good", math.nan, math.nan, 0, math.nan),
        ("good", 9.0, 0.1, 0, 0),
        ("good", 9.0, 0.3, 0, 1),
    ],  # fmt: skip
)
def test_a_wrong_run_that_is_called_good_is_counted(verdict, ate, shape, doubted, silent):
    """Where the alignment leaves the scale to the system, by the error after a similarity (metres of 10 m)."""
    metrics = metric_table.METRICS
    errors = SimpleNamespace(metrics=SimpleNamespace(ate_percent=ate, path_length=10.0), shape=shape)
    run = SimpleNamespace(prediction=Prediction("ok", verdict=verdict), errors=errors)
    assert (metrics["doubted"].find(run), metrics["silent"].find(run)) == pytest.approx((doubted, silent), nan_ok=True)
    unjudged = SimpleNamespace(prediction=Prediction("ok"), errors=errors)
    assert math.isnan(metrics["doubted"].find(unjudged)) and math.isnan(metrics["silent"].find(unjudged))
