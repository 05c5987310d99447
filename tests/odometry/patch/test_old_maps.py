"""A map file of version 2, of a sequence in progress with depth images: 4 archived keyframes, 5 in its window."""

from pathlib import Path

import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.map.io.serialisation import load_graph
from dvo.models.weights import tensor_digest
from tests.support.saved_maps import rewritten
from tests.support.tiny_tracker import network

FILE = Path(__file__).with_name("version_2.dvo")
LAST = [-0.142333, 0.153711, 0.074020, 0.118075, 0.035928, 0.036177, 0.991695]  # pose of the last of its 9 frames


def cut(rows):
    return lambda array: array[:rows]


@pytest.fixture
def old(tmp_path):
    """The file, as if the network of these tests had made it."""
    file = tmp_path / "a.dvo"
    file.write_bytes(FILE.read_bytes())
    rewritten(file, {"weights.digest": tensor_digest(network().model)}, {})
    return file


def test_its_window_is_closed(old, tmp_path):
    found = dvo.load_map(old, weights=network())
    graph = found.graph
    assert [frame.identifier for frame in graph.archive] == list(range(9)) and not len(found.window)
    assert all(frame.measured is not None and frame.image().shape == (32, 48, 3) for frame in graph.archive)
    edges = graph.archive.edges()
    assert {*edges.target} == set(range(9)) and edges.weight.max() > 0
    result = found.finish()
    assert result.frames_read == len(result.trajectory) == 9 and len(result.map.points) > 0
    np.testing.assert_allclose(result.trajectory.poses_wc[-1], LAST, atol=1e-5)
    assert result.info["keyframes"] == 9 and result.info["initialised"] and result.info["loops"] == []
    assert result.info["config"]["patches"] == 4
    assert result.metric and result.info["scale"]["source"] == "depth"
    found.save(tmp_path / "b.dvo")
    again = dvo.load_map(tmp_path / "b.dvo", weights=network()).finish()
    assert np.array_equal(again.trajectory.poses_wc, result.trajectory.poses_wc) and again.info == result.info


def test_its_graph_is_read_alone(old):
    graph = load_graph(old)
    assert len(graph.archive) == 9 and graph.log.trajectory().timestamps[-1] == pytest.approx(0.8)
    np.testing.assert_allclose(graph.log.trajectory().poses_wc[-1], LAST, atol=1e-5)


def test_a_segment_that_was_not_initialised_has_no_rows(old):
    rewritten(old, {"tracker.initialised": False, "tracker.adjustable": []}, {})
    found = dvo.load_map(old, weights=network())
    assert found.finish().frames_lost == 9 and not found.loops.finder.kept


def test_a_finished_sequence_has_an_empty_window(old):
    """Its arrays have no channels."""
    empty = {name: cut(0) for name in np.load(old).files if name.startswith("window/")}
    empty |= {name: lambda a: a[:0, :, :0] for name in ("window/matching", "window/context")}
    empty = {name.removesuffix(".npy"): change for name, change in empty.items()}
    empty["segments"] = lambda a: np.array([[0, 0], [9, 1]])
    rewritten(old, {"tracker.finished": True, "tracker.initialised": False, "graph.segment": 1}, empty)
    found = dvo.load_map(old, weights=network())
    assert len(found.graph.archive) == 4 and found.finish().frames_read == 9
    assert len(load_graph(old).archive) == 4


def test_settings_that_are_gone_are_left_out(old):
    rewritten(old, {"tracker.config": {"patches": 4, "gone": 1}}, {})
    assert dvo.load_map(old, weights=network()).config.patches == 4


def test_a_setting_with_a_value_that_is_gone_has_its_default(old):
    rewritten(old, {"tracker.config": {"patches": 4, "align": "always"}}, {})
    found = dvo.load_map(old, weights=network())
    assert found.config.align == "final" and len(found.finish().trajectory) == 9
    rewritten(old, {"tracker.config": {"patches": 4, "align": "none"}}, {})
    assert dvo.load_map(old, weights=network()).config.align == "none"


WRONG = [
    ({"tracker.keyframes": 3}, {}, "keyframes"),
    ({"tracker.config": []}, {}, "config"),
    ({"tracker.config": {"align": "sometimes"}}, {}, "align"),
    ({"tracker.info": None}, {}, "info"),
    ({"loops.loops": None}, {}, "loops"),
    ({}, {"window/keyframes": lambda a: a * 0}, "window/times"),
    ({}, {"window/keyframes": lambda a: a - 4}, "window/keyframes"),
    ({}, {"window/times": lambda a: a[::-1].copy()}, "window/times"),
    ({}, {"window/poses_cw": lambda a: a * np.float32("nan")}, "window/poses_cw"),
    ({}, {"window/edge_targets": lambda a: a + 100}, "window/edge_targets"),
    ({}, {"window/edge_patches": lambda a: a - 100}, "window/edge_patches"),
    ({}, {"window/weights": cut(3)}, "window/weights"),
    ({}, {"window/matching": lambda a: a * 1e6}, "window/matching"),
    ({}, {"window/context": lambda a: np.repeat(a, 2, 2)}, "window/context"),
    ({}, {"window/images": lambda a: a[:, 1:].copy()}, "window/images"),
    ({}, {"window/measured": cut(3)}, "window/measured"),
]


@pytest.mark.parametrize(("description", "arrays", "match"), WRONG)
def test_wrong_content_is_refused(description, arrays, match, old):
    rewritten(old, description, arrays)
    with pytest.raises(DvoError, match=match) as caught:
        dvo.load_map(old, weights=network())
    assert caught.value.file == old and caught.value.field and caught.value.remedy
