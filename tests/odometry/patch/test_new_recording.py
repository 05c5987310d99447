"""New recordings in an old map, with the shipped weights."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.geometry import sim3
from dvo.map.correction import apply_similarities
from dvo.map.merging import append_graph
from dvo.map.recordings import begin_recording
from dvo.odometry.frames.front_end import encode_image
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.loops.finder import Loop
from dvo.odometry.protocol import Status
from tests.support.archived_walk import archived_walk
from tests.support.outcome import content
from tests.support.recorded_walk import COUNT, OPTIONS, SHORT, error_of_both, map_of_room, room, street, way_back
from tests.support.tiny_tracker import frames as wall
from tests.support.tiny_tracker import network, run, tracker


@pytest.fixture(scope="module")
def walk():
    return room()


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    """Map file of the walk, and its result."""
    file = tmp_path_factory.mktemp("maps") / "old.dvo"
    return file, map_of_room(file)


def begin(file, **settings):
    return dvo.load_map(file, loop=OPTIONS, **settings)


@pytest.fixture(scope="module")
def back(walk, old):
    """Tracker of the way back in the map, its estimates, and that of the frame of the recognition repeated."""
    odometry, estimates, repeated = begin(old[0]), [], []
    for frame in way_back(walk[0]):
        estimates.append(odometry.track(frame))
        if estimates[-1].recovered:
            now = odometry.current().trajectory.poses_wc[-1]
            repeated += [now, odometry.track(replace(frame, timestamp=frame.timestamp + 0.01))]
    odometry.finish()
    return odometry, estimates, repeated


@pytest.mark.long
def test_it_is_localised_in_the_world_and_the_scale_of_the_map(walk, old, back):
    odometry, estimates, *_ = back
    result, frames = odometry.finish(), way_back(walk[0])
    found = result.info["localised"]
    assert found["in_map"] and found["joins_segments"] and found["inliers"] >= 0.25 and found["edges"] > 0
    assert 0 <= found["from"] < COUNT / 15 and found["to"] >= 100
    assert [(segment.in_map, segment.joined_to) for segment in result.segments] == [(True, None)]
    assert set(result.trajectory.timestamps) <= {frame.timestamp for frame in frames} | {
        frame.timestamp + 0.01 for frame in frames
    }
    assert len(result.trajectory) >= COUNT - 6 and result.frames_read == COUNT + 1
    assert len(result.map.points) > 1.5 * len(old[1].map.points) > 0
    assert 0 < result.info["keyframes"] <= COUNT and result.info["initialised"]
    assert error_of_both(old[1].trajectory, result.trajectory, walk[1]) < 1.0


@pytest.mark.long
def test_the_first_pose_in_the_map_is_told(walk, old, back):
    _, estimates, (now, repeated) = back
    assert {estimate.segment for estimate in estimates} == {0}
    (first,) = [k for k, estimate in enumerate(estimates) if estimate.recovered]
    assert first < 3
    live = [estimate for estimate in estimates[first:] if estimate.status is Status.TRACKING]
    live = Trajectory(np.array([e.timestamp for e in live]), np.stack([e.pose_wc for e in live]))
    assert error_of_both(old[1].trajectory, live, walk[1]) < 2.0
    np.testing.assert_allclose(estimates[first].pose_wc, now, atol=1e-6)
    assert np.array_equal(repeated.pose_wc, estimates[first].pose_wc) and not repeated.recovered


@pytest.mark.long
def test_the_map_stays_as_it_was(old, back, tmp_path):
    odometry = back[0]
    before = dvo.load_map(old[0])
    graph, begun = odometry.graph, odometry.graph.recording
    assert begun.frame == COUNT and begun.keyframe == before.state.keyframes
    assert len(graph.archive) > len(before.graph.archive)
    for frame in before.graph.archive:
        same = graph.archive[frame.identifier]
        assert np.array_equal(same.pose_cw, frame.pose_cw) and np.array_equal(same.inverse_depth, frame.inverse_depth)
    rows = graph.log.trajectory(0)
    assert np.array_equal(rows.poses_wc, old[1].trajectory.poses_wc)
    # The file of both holds the map and the new recording, and can be loaded for a third one.
    odometry.save(tmp_path / "both.dvo")
    again = dvo.load_map(tmp_path / "both.dvo")
    assert content(again.finish()) == content(odometry.finish())
    third = begin(tmp_path / "both.dvo")
    assert len(third.loops.finder.kept) == len(odometry.loops.finder.kept) and len(third.graph.recordings) == 2
    assert third.adjust() == () and content(third.current()) == content(odometry.finish())
    third.track(wall(1, size=(160, 120))[0])
    assert len(third.graph.recordings) == 3
    assert third.finish().info["localised"] is None and third.finish().frames_read == 1


@pytest.fixture(scope="module")
def elsewhere(old, tmp_path_factory):
    """Result of a recording of another place in the map, and the map that was saved before its end."""
    odometry, file = begin(old[0]), tmp_path_factory.mktemp("maps") / "both.dvo"
    for frame in street(16):
        odometry.track(frame)
    odometry.save(file)
    return odometry.finish(), file


@pytest.mark.long
def test_a_recording_that_was_not_recognised_is_saved_with_its_map(old, elsewhere):
    found = dvo.load_map(elsewhere[1])
    assert len(found.graph.recordings) == 2 and found.loops.finder.kept[-1] >= found.graph.recording.keyframe
    result = found.finish()
    assert result.info["localised"] is None and result.frames_read == 16
    assert not any(segment.in_map for segment in result.segments)
    assert np.array_equal(found.graph.log.trajectory(0).poses_wc, old[1].trajectory.poses_wc)


@pytest.mark.long
def test_another_place_is_not_recognised(elsewhere):
    result = elsewhere[0]
    assert result.info["localised"] is None and result.info["loops"] == []
    assert result.segments and not any(segment.in_map for segment in result.segments)
    assert set(result.trajectory.timestamps) <= {k / 15 for k in range(16)}


@pytest.mark.long
def test_a_map_in_progress_without_loops_is_described(walk, tmp_path):
    odometry = dvo.load("small", device="cpu", **SHORT, loops=False)
    for frame in walk[0][14:30]:
        odometry.track(frame)
    odometry.save(tmp_path / "a.dvo")
    found = dvo.load_map(tmp_path / "a.dvo", new_recording=True, updates=2, seed=5)
    assert not len(found.window) and not odometry.gate.finished
    assert (found.config.updates, found.config.loops, found.seed) == (2, True, 5)
    kept = found.loops.finder.kept
    assert kept[-1] == odometry.window.frames[-1].identifier
    assert found.loops.finder.places.identifiers.tolist() == kept
    assert found.current().info["config"]["loops"] is False and found.current().info["seed"] == 0
    # Saved before its first frame it still knows the size that its frames must have.
    found.save(tmp_path / "b.dvo")
    for tracker_ in (found, dvo.load_map(tmp_path / "b.dvo")):
        for size in ((160, 96), (80, 60)):
            with pytest.raises(DvoError, match=r"images of the map are 160x120.*pixels=19200"):
                tracker_.track(wall(1, size=size)[0])


@pytest.mark.long
def test_the_keyframes_of_the_window_have_the_same_descriptors_as_computed_from_their_images(walk, tmp_path):
    """Those of the map of a sequence in progress come from the tracker; they agree with the archived image."""
    odometry = dvo.load("small", device="cpu", **SHORT)
    for frame in walk[0][:20]:
        odometry.track(frame)
    odometry.save(tmp_path / "a.dvo")
    places = dvo.load_map(tmp_path / "a.dvo").loops.finder.places
    last = odometry.window.frames[-1].identifier
    assert places.identifiers[-1] == last
    with torch.inference_mode():
        image = odometry.window.frames[-1].image
        again = odometry.loops.finder.descriptor(image, encode_image(odometry.network, image, odometry.device).matching)
    np.testing.assert_allclose(places.descriptor(last), again, atol=1e-3)


@pytest.mark.parametrize(
    ("settings", "match"),
    [({"patches": 8}, "the map has 16"), ({"loops": False}, "turned off"), ({"colour": 1}, "colour"),
     ({"preset": "accurate"}, "the map has 16")],
)  # fmt: skip
def test_settings_that_do_not_go_with_the_map(settings, match, old):
    with pytest.raises(DvoError, match=match):
        begin(old[0], **settings)


def test_a_map_that_cannot_be_recognised_is_read_and_takes_no_frames(tmp_path):
    for name, count in (("empty", 0), ("tiny", 9)):
        odometry = tracker()
        run(odometry, wall(count))
        odometry.save(tmp_path / f"{name}.dvo")
        found = dvo.load_map(tmp_path / f"{name}.dvo", weights=network())
        with pytest.raises(DvoError, match="no keyframes that can be recognised"):
            found.track(wall(1)[0])
        assert found.finish().frames_read == count


def three_walks():
    """Graph of one walk thrice: two segments of a map, the second in another world of twice the scale, and a new
    recording in a third one."""
    graph = archived_walk(12)[0]
    for number in (1, 2):
        graph.begin_segment(12 * number)
        begin_recording(graph)
        append_graph(graph, archived_walk(12)[0])
        identifiers = np.arange(12 * number, 12 * number + 12)
        twist = torch.tensor([0.3, -0.2, 0.5, 0.1, 0.2, -0.3, 0.0], dtype=torch.float64) * number
        move = sim3.compose(sim3.exp(twist), sim3.from_se3(torch.tensor([0.0] * 6 + [1.0]).double(), 0.5))
        before = sim3.from_se3(graph.poses_cw(identifiers))
        apply_similarities(graph, identifiers, sim3.compose(before, move.expand_as(before)))
    del graph.recordings[1]
    return graph


def seen_again(graph, old, new):
    """Loop of two keyframes of the same place, each in the unit of its segment."""
    unit = 2.0 if old < 12 else 0.5  # of the newer one, per unit of the older: the second loop is found after the first
    place = torch.tensor([0, 0, 0, 0, 0, 0, 1.0, unit], dtype=torch.float64)
    times = graph.archive[old].timestamp, graph.archive[new].timestamp
    return Loop(old, new, *times, "retrieval", 1.0, place, 1, None, True)


def test_worlds_of_a_map_that_a_recording_connects():
    """The earliest world stays, bit for bit; the other one of the map moves into it, although its keyframe is older."""
    graph = three_walks()
    assert len(graph.recordings) == 2 and graph.recording.keyframe == 24
    closer = LoopCloser(graph, SimpleNamespace(kept=list(range(36)), options=OPTIONS))
    at = [np.arange(12 * k, 12 * k + 12) for k in range(3)]
    first = graph.poses_cw(at[0])
    for old, new, joined in ((4, 28, [0, 1, 0]), (18, 30, [0, 0, 0])):
        loop = seen_again(graph, old, new)
        closer.loops.append(loop)
        closer.correct(loop)
        assert closer.drain()
        assert [graph.world_of(k) for k in range(3)] == joined
        assert torch.equal(graph.poses_cw(at[0]), first)
    for k in (1, 2):
        torch.testing.assert_close(graph.poses_cw(at[k]), first, atol=1e-6, rtol=0)
        depths = [np.stack([graph.archive[int(i)].inverse_depth for i in at[n]]) for n in (0, k)]
        np.testing.assert_allclose(depths[1], depths[0], rtol=1e-5)
