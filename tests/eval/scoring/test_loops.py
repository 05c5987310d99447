"""Loops against rendered truth: revisits, right and false loops, recall."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from eval.scoring.loops import NEAR, OLDER, RIGHT, Revisits, loop_errors, revisits_of, told_loops
from eval.suites.suite import Sequence

ROUND = 28 / 1.4
LAPS: dict[str, Any] = {
    "seed": 3_900_000_000, "family": "hall", "apart": True, "kind": "revisit", "frames": 56, "fps": 2.0, "width": 64,
    "height": 48, "speed": 2.0, "version": 1,
}  # fmt: skip
SEQUENCE = Sequence("laps", rendered=tuple(sorted(LAPS.items())))
STAMPS = (np.arange(56) / 2).tolist()


@pytest.fixture(scope="module")
def truth() -> Revisits:
    found = revisits_of(SEQUENCE)
    assert found is not None
    return found


def told(*loops: tuple[float, float, float]) -> dict[str, Any]:
    return {"loops": [{"from": new, "to": old, "inliers": score} for new, old, score in loops]}


def test_the_second_lap_is_a_revisit(truth: Revisits) -> None:
    times = truth.revisited(np.zeros(0))
    assert set(np.arange(ROUND, 28.0)) <= set(times.tolist())
    assert times.min() >= OLDER
    share, most = truth.views(np.array([[ROUND + 3, 3.0], [ROUND + 3, ROUND + 3]]))
    assert share[0] > RIGHT and share[1] == most[1] == pytest.approx(1)


def test_what_was_dark_is_no_revisit(truth: Revisits) -> None:
    every = truth.revisited(np.zeros(0))
    later = truth.revisited(np.arange(44, 50) / 2)  # the visit now is dark
    assert set(every.tolist()) - set(later.tolist()) == {22.0, 23.0, 24.0}
    assert len(truth.revisited(np.arange(0, 36) / 2)) == 0  # all earlier visits were


def opposite(truth: Revisits) -> tuple[float, float]:
    """Two times of views that share nothing."""
    for old in np.arange(0.0, 9.0):
        for new in np.arange(old + 4, 18.0):
            if truth.views(np.array([[new, old]]))[1][0] == 0:
                return float(new), float(old)
    raise AssertionError("every view shares something with every other")


def test_recall_and_false_loops(truth: Revisits) -> None:
    times = truth.revisited(np.zeros(0))
    right = (ROUND + 2, 2.0, 0.6)
    one = loop_errors(told(right), SEQUENCE, STAMPS)
    assert (one.loops, one.right, one.false, one.revisit_s) == (1, 1, 0, len(times))
    assert one.recall == pytest.approx(np.mean(np.abs(times - right[0]) <= NEAR))
    every = loop_errors(told(*[(float(t), float(t) - ROUND, 0.5) for t in times if t >= ROUND]), SEQUENCE, STAMPS)
    assert every.right == every.loops and every.recall > one.recall and (len(times) > 9 or every.recall == 1)
    new, old = opposite(truth)
    weaker = loop_errors(told(right, (new, old, 0.5)), SEQUENCE, STAMPS)
    assert weaker.false == 1 and weaker.recall == one.recall  # a threshold between the two would refuse it
    stronger = loop_errors(told(right, (new, old, 0.7)), SEQUENCE, STAMPS)
    assert stronger.false == 1 and stronger.recall == 0
    none = loop_errors(told(), SEQUENCE, STAMPS)
    assert (none.loops, none.false, none.recall) == (0, 0, 0)


def test_without_loops_or_truth() -> None:
    silent = loop_errors({}, SEQUENCE, STAMPS)
    assert math.isnan(silent.loops) and math.isnan(silent.recall) and silent.revisit_s > 0
    recorded = loop_errors(told((1.0, 0.0, 1.0)), Sequence("clip", "folder"), STAMPS)
    assert recorded.loops == 1 and math.isnan(recorded.false) and math.isnan(recorded.revisit_s)
    short = loop_errors(told(), Sequence("short", rendered=(("no such option", 1),)), STAMPS[:16])
    assert short.revisit_s == 0 and short.false == 0 and math.isnan(short.recall)


@pytest.mark.parametrize(
    "content", [3, "two", [1.0], [{"from": 1.0}], [{"from": 1.0, "to": True}], [{"from": math.nan, "to": 0.0}]]
)
def test_what_is_no_list_of_loops(content: Any) -> None:
    assert told_loops({"loops": content}) is None
    assert told_loops({"loops": [{"from": 2, "to": 1.0}]}) == [{"from": 2, "to": 1.0}]
