"""Metrics of other packages beside those of the package."""

import pytest

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.metrics.table import Metric
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
