"""Global adjustments in map files."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from dvo.errors import DvoError
from dvo.graph.map_file import open_map_file, write_map_file
from dvo.odometry.adjuster import Adjuster, Adjusting
from dvo.odometry.adjuster_saving import AdjusterTable, adjuster_arrays, adjuster_table, restore_adjuster
from dvo.odometry.background import Task
from dvo.odometry.final_adjustment import AdjustmentOptions
from dvo.odometry.graph_adjustment import prepare
from dvo.odometry.loop_closure import LoopCloser
from dvo.odometry.rolling_shutter import Shutter
from tests.archived_walk import archived_walk


def closer_of(graph):
    return LoopCloser(graph, None, adjuster=Adjuster(graph, None, AdjustmentOptions()))


def adjusting():
    """Loop closure with an adjustment that was made, one in progress and one that waits."""
    graph, _ = archived_walk(frames=12, dropped=(5,))
    closer = closer_of(graph)
    found = prepare(graph, 0, Shutter(0.0, 60.0), AdjustmentOptions()).solve()
    closer.adjuster.records.append(found.record(0.1, 0.3, "loop"))
    closer.adjuster.want([0])
    closer.work = Adjusting(Task.finished(found), 4, 0, "request", 0.5)
    return closer


def restored(file, closer, arrays=None, **changes):
    table = asdict(replace(adjuster_table(closer), **changes))
    write_map_file(file, {"adjuster": table}, adjuster_arrays(closer) | (arrays or {}))
    new = closer_of(closer.graph)
    with open_map_file(file) as source:
        restore_adjuster(source, new, source.table(AdjusterTable, "adjuster"))
    return new


def test_an_adjustment_in_progress_is_restored_bit_for_bit(tmp_path):
    closer = adjusting()
    new = restored(tmp_path / "map.dvo", closer)
    assert new.adjuster.records == closer.adjuster.records and new.adjuster.wanted == [0]
    mine, other = (x.work.task.result() for x in (new, closer))
    assert replace(new.work, task=None) == replace(closer.work, task=None)
    assert np.array_equal(mine.identifiers, other.identifiers) and torch.equal(mine.similarities, other.similarities)
    assert mine.inverse_depths.tobytes() == other.inverse_depths.tobytes()
    assert mine.record(0.0, 1.0, "loop") == other.record(0.0, 1.0, "loop")


def test_without_adjustments_nothing_is_written():
    closer = closer_of(archived_walk(frames=3)[0])
    assert adjuster_table(closer) is None and adjuster_arrays(closer) == {}
    assert adjuster_table(LoopCloser(None, None)) is None


@pytest.mark.parametrize(
    "arrays, changes, match",
    [
        ({}, {"world": 3}, "world"),
        ({}, {"wanted": (3,)}, "wanted"),
        ({"adjustment/keyframes": np.arange(3)}, {}, "similarities"),
        ({"adjustment/keyframes": np.arange(50, 61)}, {}, "keyframes"),
        ({"adjustment/keyframes": np.arange(11)[::-1].copy()}, {}, "keyframes"),
        ({"adjustment/similarities": np.zeros((11, 8))}, {}, "similarities"),
        ({"adjustment/inverse_depths": np.zeros((11, 5), np.float32)}, {}, "inverse_depths"),
    ],
)
def test_a_state_that_would_fail_later_is_refused(arrays, changes, match, tmp_path):
    closer = adjusting()
    assert len(closer.work.task.result().identifiers) == 11
    with pytest.raises(DvoError, match=match):
        restored(tmp_path / "map.dvo", closer, arrays, **changes)
