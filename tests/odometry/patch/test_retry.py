"""Retries: frames that could not be joined get a pose once a later frame has been, and only if it is valid."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.metrics import align_trajectory
from dvo.odometry.patch import retry
from dvo.odometry.protocol import Status
from dvo.odometry.window import patch_window
from dvo.odometry.window.patch_window import PatchWindow
from dvo.odometry.window.pose_validation import PoseSupport, support_of
from dvo.synth.sequence import make_sequence
from tests.support.changed_images import with_images
from tests.support.outcome import content, told
from tests.support.saved_maps import FAST

CUT, DARK, END = 16, 6, 28
BACK = CUT + DARK  # first frame after the darkness
SIZE = {"height": 120, "width": 160, "fps": 15.0, "sensor": False}


@pytest.fixture(scope="module")
def film():
    return make_sequence(61, frames=END, family="room", kind="handheld", speed=3.0, **SIZE)


@pytest.fixture(scope="module")
def dark(film):
    """Frames of a room with some black ones."""
    clear = list(film)
    return with_images(clear, [np.zeros_like(clear[0].image)] * DARK, CUT)


@pytest.fixture(scope="module")
def foreign():
    return make_sequence(62, frames=1, family="corridor", kind="handheld", **SIZE).frame(0).image


def refuse(monkeypatch, *times):
    """Refuse frames when they are the newest of the window, as measurements of a bad first try would."""
    real = PatchWindow.try_insert

    def refused(self, view, *given):
        policy = given[-1]
        if not policy.later and view.records[0].timestamp in times:
            policy = replace(policy, rounds=tuple(replace(one, inliers=2.0) for one in policy.rounds))
        return real(self, view, *given[:-1], policy)

    monkeypatch.setattr(PatchWindow, "try_insert", refused)


def count_tries(monkeypatch):
    """Whether each late try was successful, a list that grows."""
    real, tries = retry._join, []
    monkeypatch.setattr(retry, "_join", lambda *given: tries.append(real(*given)) or tries[-1])
    return tries


def track(frames, weights="small", **settings):
    odometry = dvo.load(weights, device="cpu", **{**FAST, **settings})
    return [odometry.track(frame) for frame in frames], odometry.finish(), odometry


def lost_frames(frames, result):
    rows = np.concatenate([segment.trajectory.timestamps for segment in result.segments])
    return np.flatnonzero(~np.isin([frame.timestamp for frame in frames], rows)).tolist()


@pytest.mark.long
@pytest.mark.parametrize(
    ("weights", "settings"),
    [("small", {}), pytest.param("mamba", {}, marks=pytest.mark.slow), ("small", {"preset": "fast"})],
)
def test_the_frame_after_the_dark_gets_a_pose_with_the_next_one(film, dark, monkeypatch, weights, settings):
    first = dark[BACK].timestamp
    refuse(monkeypatch, first)
    estimates, result, odometry = track(dark, weights, **settings)
    assert estimates[BACK].status is Status.LOST and estimates[BACK].pose_wc is None
    assert estimates[BACK + 1].status is Status.TRACKING
    assert lost_frames(dark, result) == list(range(CUT, BACK)) and result.frames_lost == DARK
    assert len(result.segments) == 1
    assert [(b.start, b.end, b.frames) for b in result.breaks] == [(dark[CUT - 1].timestamp, first, DARK)]
    # As exact as its neighbours.
    aligned = align_trajectory(result.trajectory, film.groundtruth)
    rows = np.searchsorted(film.groundtruth.timestamps, aligned.timestamps)
    error = np.linalg.norm(aligned.positions - film.groundtruth.positions[rows], axis=1)
    late = int(np.flatnonzero(aligned.timestamps == first)[0])
    assert error[late] < 3 * max(error[late - 3 : late].max(), error[late + 1 : late + 4].max())
    # A dropped keyframe in the order of time, relative to an earlier one, with measurements.
    dropped = next(frame for frame in odometry.graph.archive if frame.timestamp == first)
    assert dropped.anchor is not None and dropped.anchor < dropped.identifier
    times = [frame.timestamp for frame in odometry.graph.archive]
    assert times == sorted(times)
    edges = odometry.graph.archive.edges()
    own = dropped.identifier
    assert {*edges.target[edges.source == own]} & {*edges.source[edges.target == own]}


@pytest.mark.long
@pytest.mark.slow
def test_the_newest_views_are_tried_again_up_to_one_that_fails(dark, foreign, monkeypatch):
    refuse(monkeypatch, *(frame.timestamp for frame in dark[BACK : BACK + 3]))
    assert lost_frames(dark, track(dark, join_inliers=0.2)[1]) == list(range(CUT, BACK + 1))
    other = with_images(dark, [foreign], BACK + 1)
    assert lost_frames(other, track(other, join_inliers=0.2)[1]) == list(range(CUT, BACK + 2))


@pytest.mark.long
def test_a_view_that_is_not_supported_changes_nothing(dark, foreign, monkeypatch, tmp_path):
    """Results and files are those of a tracker that does not try again, byte for byte."""
    frames = with_images(dark, [foreign], BACK)
    tries, kept = count_tries(monkeypatch), []
    for name in ("tried", "not"):
        if name == "not":
            monkeypatch.setattr(retry, "_join", lambda *given: False)
        odometry = dvo.load("small", device="cpu", **FAST)
        estimates = []
        for frame in frames:
            estimates.append(told(odometry.track(frame)))
            if len(estimates) == BACK + 2:
                odometry.save(tmp_path / f"{name}.dvo")
        kept.append((estimates, content(odometry.finish())))
    assert tries == [False]
    assert kept[0] == kept[1]
    assert (tmp_path / "tried.dvo").read_bytes() == (tmp_path / "not.dvo").read_bytes()


@pytest.mark.long
@pytest.mark.slow
def test_a_pose_that_would_cost_the_newest_frame_its_own_is_refused(dark, monkeypatch):
    refuse(monkeypatch, dark[BACK].timestamp)
    try_insert, support = PatchWindow.try_insert, patch_window.support_of

    def tried(self, *given):
        late = given[-1].later
        newest = lambda window, k: PoseSupport(1.0, 0.0) if late and k == len(window) - 1 else support(window, k)  # noqa: E731
        with monkeypatch.context() as patch:
            patch.setattr(patch_window, "support_of", newest)
            return try_insert(self, *given)

    monkeypatch.setattr(PatchWindow, "try_insert", tried)
    assert BACK in lost_frames(dark, track(dark)[1])


@pytest.mark.long
def test_later_frames_do_not_count(dark):
    """What counts for a frame is what counted when it was the newest."""
    odometry = dvo.load("small", device="cpu", **FAST)
    for frame in dark[:14]:
        odometry.track(frame)
    window = odometry.window
    k = len(window) - 3
    whole = support_of(window, k)
    assert whole.inliers > 0
    into = window.jj == k
    for among, same in ((into & (window.ii > k), True), (into & (window.ii < k), False)):
        assert bool(among.any())
        kept, window.confidence = window.confidence, torch.where(among[:, None], 0.01, window.confidence)
        assert (support_of(window, k) == whole) is same
        window.confidence = kept


@pytest.mark.long
@pytest.mark.slow
def test_a_repetition_of_a_view_that_was_joined_late_shares_its_pose(dark, monkeypatch):
    frames = with_images(dark, [dark[BACK].image], BACK + 1)
    refuse(monkeypatch, frames[BACK].timestamp)
    tries = count_tries(monkeypatch)
    _, result, _ = track(frames)
    assert tries == [True] and lost_frames(frames, result) == list(range(CUT, BACK))
    poses = dict(zip(result.trajectory.timestamps, result.trajectory.poses_wc.tolist(), strict=True))
    assert poses[frames[BACK].timestamp] == poses[frames[BACK + 1].timestamp]


@pytest.mark.long
def test_a_gap_in_time_is_told_before_the_frame_that_was_joined_late(film, monkeypatch):
    clear = list(film)
    later = [replace(frame, timestamp=frame.timestamp + 5.0) for frame in clear[CUT + 3 :]]
    refuse(monkeypatch, later[0].timestamp)
    _, result, _ = track([*clear[:CUT], *later])
    told = [(b.start, b.end, b.frames, b.reason[:3]) for b in result.breaks]
    assert told == [(clear[CUT - 1].timestamp, later[0].timestamp, 0, "gap")]
