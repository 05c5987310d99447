"""Loops of a walk there and back, with the shipped weights."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3, so3
from dvo.metrics import evaluate
from dvo.odometry.loops import correction as loop_correction
from dvo.odometry.loops import joint_window as loop_window
from dvo.odometry.loops.check import Limits, median_inverse_depth
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.loops.options import LoopOptions
from dvo.odometry.maintenance.background import Steps, all_steps
from dvo.synth.sequence import make_sequence
from tests.support.loop_walk import OPTIONS, SHORT, THERE, there_and_back, track, until


@pytest.fixture(scope="module")
def film():
    return there_and_back()


@pytest.fixture(scope="module")
def closed(film):
    return track(film[0])


def kind(loops):
    """Kind of the job in progress; None without one."""
    return None if loops.maintenance.job is None else loops.maintenance.job.kind


@pytest.mark.long
def test_loops_are_found_where_the_way_is_repeated(film, closed):
    odometry, _, result = closed
    loops = result.info["loops"]
    assert len(loops) >= 2 and result.info["loop_corrections"] == odometry.loops.corrections
    assert loops == sorted(loops, key=lambda loop: loop["from"])
    turn, rows = (THERE - 1) / 15.0, film[1]
    assert sum(loop["to"] < turn < loop["from"] for loop in loops) >= 2
    for loop in loops:
        assert loop["from"] - loop["to"] >= OPTIONS.seconds
        assert loop["inliers"] >= Limits().weak_inliers and loop["edges"] > 0 and not loop["joins_segments"]
    scale = evaluate(result.trajectory, rows).scale
    for loop in odometry.loops.loops:  # what was measured is the true motion between the visits
        old, new = (
            torch.from_numpy(rows.poses_wc[int(np.abs(rows.timestamps - time).argmin())])
            for time in (loop.old_time, loop.new_time)
        )
        true = se3.relative(se3.inverse(old), se3.inverse(new))
        found = loop.measurement[:3] / loop.measurement[7] * scale
        assert (found - true[:3]).norm() < 0.15 and so3.angle(loop.measurement[3:7]) == pytest.approx(
            float(so3.angle(true[3:])), abs=0.02
        )
    assert evaluate(result.trajectory, film[1]).ate_percent < 0.5


def turned_away(finder):
    """Search of a repeated view, with a candidate whose pose to start from is turned by 30 degrees."""
    time = {identifier: finder.graph.archive[identifier].timestamp for identifier in finder.kept}
    new = finder.kept[-5]
    mirrored = 2 * (THERE - 1) / 15.0 - time[new]
    old = min(finder.kept[1:], key=lambda identifier: abs(time[identifier] - mirrored))
    search = finder.prepare(new)
    kept = next(pair for pair in search.pairs if pair.candidate.new == new)
    first = finder.kept.index(old) - 1
    group = finder.kept[first : first + 3]  # with its neighbours
    poses_cw = finder.graph.poses_cw(np.array(group))
    turn = se3.exp(torch.tensor([0, 0, 0, 0, math.radians(30), 0], dtype=torch.float64))
    start = se3.compose(turn, poses_cw[group.index(old)])
    candidate = replace(kept.candidate, old=old, kind="retrieval", pose_cw=start)
    frames = tuple(finder.graph.archive[identifier] for identifier in group)
    pair = replace(kept, candidate=candidate, old=frames, old_cw=poses_cw)
    return replace(search, pairs=(pair,), predicted=0)


@pytest.mark.long
def test_a_place_is_recognised_from_a_wrong_start(closed):
    """The network alone does not find the way from a view that is 30 degrees off; the guessed pose is near enough."""
    finder = closed[0].loops.finder
    search = turned_away(finder)
    (pair,) = search.pairs
    decisions = ((2, 0.0), (2, Limits().inliers), (8, Limits().inliers))
    with torch.inference_mode():
        assert all_steps(finder.matcher.match(pair.old, pair.new, pair.start, decisions)) is None
        loop = all_steps(finder.verify(search))
        assert loop is not None and loop.inliers > 2 * Limits().inliers
        old_cw = sim3.from_se3(finder.graph.poses_cw(np.array([loop.old]))[0])
        assert sim3.compose(loop.measurement, old_cw)[3:7].abs()[3] > 0.99
        predicted = replace(search, predicted=1)  # is matched from where it is predicted, without a guess
        assert all_steps(finder.verify(predicted)) is None


@pytest.mark.long
@pytest.mark.slow
def test_a_match_ends_once_further_updates_change_nothing(closed, monkeypatch):
    """Asked of several pairs: how far a single one goes on moving depends on its view."""
    finder, errors = closed[0].loops.finder, []
    for new in finder.kept[-2::-3][:5]:
        pair = next((pair for pair in finder.prepare(new).pairs if pair.candidate.kind == "proximity"), None)
        if pair is None:
            continue
        matches, lengths = [], []
        for limits in (loop_window.SETTLED_CHANGES, (-1.0, -1.0, -1.0)):
            monkeypatch.setattr(loop_window, "SETTLED_CHANGES", limits)
            steps = 0
            work = finder.matcher.match(pair.old, pair.new, pair.start, ((2, 0.0), (2, 0.0), (40, 0.0)))
            task = Steps(work)
            while not task.step():
                steps += 1
            matches.append(task.result())
            lengths.append(steps)
        monkeypatch.undo()
        quick, whole = matches
        moved = se3.relative(quick.poses_cw, whole.poses_cw)
        far = float(moved[:, :3].norm(dim=1).max()) * median_inverse_depth(pair.later)
        angle, scale = float(so3.angle(moved[:, 3:]).max()), abs(quick.scale / whole.scale - 1)
        errors.append((lengths[0] - lengths[1] + 20, abs(quick.inliers - whole.inliers) / 0.05, scale / 0.01,
                       angle / 0.002, far / 0.01))  # fmt: skip
        assert lengths[1] > 40
    assert len(errors) >= 3
    assert np.median(errors, axis=0)[0] < 0 and (np.median(errors, axis=0)[1:] < 1).all()


@pytest.mark.long
def test_a_match_with_few_inliers_has_to_agree_with_the_poses(closed, monkeypatch):
    finder = closed[0].loops.finder
    search = turned_away(finder)
    with torch.inference_mode():
        weak = replace(finder.limits, inliers=1.0)  # no match is sure
        monkeypatch.setattr(finder, "limits", weak)
        assert all_steps(finder.verify(search)) is not None
        moved = search.pairs[0].present_cw.clone()
        moved[0] += 2 * weak.translation / median_inverse_depth(search.pairs[0].later)
        drifted = replace(search, pairs=(replace(search.pairs[0], present_cw=moved),))
        assert all_steps(finder.verify(drifted)) is None
        monkeypatch.setattr(finder, "limits", replace(weak, inliers=0.4))
        assert all_steps(finder.verify(drifted)) is not None


@pytest.mark.long
def test_a_keyframe_long_after_the_one_before_counts_more(closed):
    finder = closed[0].loops.finder
    times = np.array([finder.graph.archive[k].timestamp for k in finder.kept])

    def counts(pace):
        fresh = replace(finder, kept=[], pace=pace)
        return [fresh.keep(k) for k in finder.kept]

    assert counts(1e6) == [1] * len(times)
    found = counts(0.125)
    assert found == [1, *np.maximum(1, np.floor(np.diff(times) / 0.125)).astype(int).tolist()] and max(found) > 1
    assert (np.diff(replace(finder, pace=0.125).counted()) == found[1:]).all()


@pytest.mark.long
def test_at_the_end_keyframes_that_are_far_apart_are_all_searched(closed, monkeypatch):
    closer, found = closed[0].loops, {}
    finder = closer.finder
    monkeypatch.setattr(closer, "loops", closer.loops[:1])
    for pace in (1e6, 0.01):
        monkeypatch.setattr(finder, "options", replace(OPTIONS, every=12))
        monkeypatch.setattr(finder, "pace", pace)
        found[pace] = []
        monkeypatch.setattr(finder, "find", lambda new, pending=None, looked=found[pace]: looked.append(new))
        assert not closer.complete(closed[0].state.adjustable)
    known = finder.kept.index(closer.loops[0].new)
    rare = [finder.kept.index(new) for new in found[1e6]]
    assert 0 < len(rare) <= len(finder.kept) / 6 + 2 and min(abs(row - known) for row in rare) >= 6
    assert len(found[0.01]) > 2 * len(rare)


@pytest.fixture
def correcting(film):
    """Tracker with a correction in progress."""
    return until(film, lambda loops: kind(loops) == "correction")[0]


@pytest.mark.long
@pytest.mark.slow
def test_saving_leaves_work_in_progress_alone(tmp_path):
    """Maps are those before the result of a search, or a correction, is there."""
    frames, _ = there_and_back(36)  # so long that a correction is applied before the end
    closed = track(frames)
    states = {
        "searching": lambda loops: kind(loops) == "search" and loops.pending is not None,
        "correcting": lambda loops: kind(loops) == "correction",
        "closed": lambda loops: loops.corrections > 0 and loops.maintenance.job is None,
    }
    odometry, saved = dvo.load("small", device="cpu", loop=OPTIONS, **SHORT), {}
    for frame in frames:
        odometry.track(frame)
        for name in [name for name, state in states.items() if name not in saved and state(odometry.loops)]:
            saved[name] = [loop.measurement for loop in odometry.loops.loops]
            odometry.save(tmp_path / f"{name}.dvo")
    result = odometry.finish()
    assert saved.keys() == states.keys() and len(saved["closed"]) > 1
    assert np.array_equal(result.trajectory.poses_wc, closed[2].trajectory.poses_wc)
    assert result.info["loops"] == closed[2].info["loops"]
    for name, loops in saved.items():
        found = dvo.load_map(tmp_path / f"{name}.dvo").loops
        assert found.maintenance.job is None and found.finder.kept[-1] > found.graph.archive.keyframes[0].identifier
        assert all(torch.equal(mine.measurement, other) for mine, other in zip(found.loops, loops, strict=True))
    odometry.save(tmp_path / "done.dvo")
    assert dvo.load_map(tmp_path / "done.dvo").finish().info["loops"] == result.info["loops"]


def test_a_correction_at_the_end_moves_keyframes_that_were_not_looked_at(correcting):
    """The window is archived with a correction in progress: its keyframes keep their place after the last one."""
    graph, loops = correcting.graph, correcting.loops
    while len(graph.window):
        graph.archive_oldest()
    last, later = loops.finder.kept[-1], [frame.identifier for frame in graph.archive.kept_after(loops.finder.kept[-1])]
    identifiers, found = loops.maintenance.job.task.result()
    scale = float(found[identifiers.tolist().index(last), 7])
    steps = [se3.relative(*graph.poses_cw(np.array([last, k]))) for k in later]
    loops.wait = 1000  # no further search
    assert loops.advance([0], at_once=True) and loops.corrections == 1
    change = max(float(step[:3].norm()) for step in steps) * abs(1 / scale - 1)
    assert len(later) > 1 and change > 1e-5, "ten times what the comparison below allows"
    for k, step in zip(later, steps, strict=True):
        now = se3.relative(*graph.poses_cw(np.array([last, k])))
        wanted = torch.cat([step[:3] / scale, step[3:]])
        assert torch.allclose(now, wanted, atol=1e-6)


def released(graph, identifiers):
    """Release the patches of keyframes, as the archive does beyond its bound."""
    for identifier in identifiers:
        centres, depth, colors = np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.uint8)
        graph.archive.add(replace(graph.archive[identifier], centres=centres, inverse_depth=depth, colors=colors))


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_keyframes_without_patches_are_corrected_with_the_others(correcting):
    """The oldest patches were released while a search ran: the pose graph takes the depth of the nearest patches."""
    graph, kept, loops = correcting.graph, correcting.loops.finder.kept, correcting.loops.loops
    plain = loop_correction.prepare(graph, kept, loops, loops[-1])
    depths = {k: float(np.median(graph.archive[k].inverse_depth)) for k in kept}
    released(graph, kept[:3])
    found = loop_correction.prepare(graph, kept, loops, loops[-1])
    ratio = (found.weight / plain.weight)[:, 0]  # of translations: inverse squares of the depths
    for row, end in enumerate(found.jj.tolist()):
        expected = (depths[kept[3]] / depths[kept[end]]) ** 2 if end < 3 else 1.0
        assert float(ratio[row]) == pytest.approx(expected, rel=1e-9)
    assert sum(end < 3 for end in found.jj.tolist()) == 2 and torch.equal(found.weight[:, 3:], plain.weight[:, 3:])
    assert torch.isfinite(found.solve()).all() and (found.solve() - plain.solve()).norm(dim=1).max() < 0.05
    released(graph, kept[3:])
    assert torch.isfinite(loop_correction.prepare(graph, kept, loops, loops[-1]).solve()).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_a_loop_of_a_keyframe_whose_patches_were_released_counts_for_nothing(correcting):
    loops, loop = correcting.loops, correcting.loops.loops[-1]
    assert loops.finder.agree(loop, loop) and loops.is_within(loop, (1e6, 4.0, 1e6))
    released(correcting.graph, [loop.new])
    assert not loops.finder.agree(loop, loop) and not loops.is_within(loop, (1e6, 4.0, 1e6))


@pytest.mark.slow
def test_an_interruption_while_a_frame_waits_leaves_the_work(correcting, monkeypatch):
    loops, work = correcting.loops, correcting.loops.maintenance.job

    def pressed():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(work.task, "result", pressed)
        loops.advance([0], at_once=True)
    assert loops.maintenance.job is work and not loops.corrections
    assert loops.advance([0], at_once=True) and loops.corrections == 1


@pytest.mark.long
@pytest.mark.slow
def test_a_search_at_once_finds_the_same_places(film, closed):
    """Without a delay, searches and corrections are done within ``track``."""
    odometry, _, result = track(film[0], replace(OPTIONS, delay=0))
    assert odometry.loops.maintenance.job is None and odometry.loops.corrections
    assert evaluate(result.trajectory, film[1]).ate_percent < 0.5


@pytest.mark.slow
def test_in_real_time_a_frame_does_not_wait_for_a_search(monkeypatch):
    """A search that never ends until the end of the sequence holds up no frame."""
    odometry = dvo.load("small", device="cpu", loop=OPTIONS, **SHORT, real_time=True)
    release, real = threading.Event(), odometry.loops.finder.verify

    def slow(search):
        assert release.wait(60)
        return (yield from real(search))

    monkeypatch.setattr(odometry.loops.finder, "verify", slow)
    estimates = [odometry.track(frame) for frame in there_and_back(40)[0][:64]]
    assert kind(odometry.loops) == "search" and not odometry.loops.maintenance.job.task.done
    assert sum(estimate.pose_wc is not None for estimate in estimates) > 45
    release.set()
    assert odometry.finish().info["loops"] is not None and odometry.loops.maintenance.job is None


@pytest.mark.long
def test_a_search_that_fails_ends_the_frame_that_takes_its_result(film, monkeypatch):
    odometry = dvo.load("small", device="cpu", loop=OPTIONS, **SHORT)

    def broken(search):
        yield
        raise RuntimeError("out of memory")

    monkeypatch.setattr(odometry.loops.finder, "verify", broken)
    with pytest.raises(RuntimeError, match="out of memory"):
        for frame in film[0]:
            odometry.track(frame)


@pytest.mark.long
@pytest.mark.slow
def test_without_loops_nothing_is_searched_or_kept(film, closed):
    odometry, estimates, result = track(film[0], loops=False)
    assert "loops" not in result.info and not odometry.loops.finder.kept
    # Up to the first correction the estimates are the same.
    first = min(loop["from"] for loop in closed[2].info["loops"])
    for mine, other in zip(estimates, closed[1], strict=True):
        if mine.timestamp > first:
            break
        assert (mine.pose_wc is None) == (other.pose_wc is None)
        assert mine.pose_wc is None or np.array_equal(mine.pose_wc, other.pose_wc)


@pytest.mark.slow
def test_a_loop_that_is_far_too_recent_is_none(film):
    _, _, result = track(film[0], replace(OPTIONS, seconds=60.0))
    assert result.info["loops"] == []


@pytest.mark.slow
def test_a_scene_never_seen_before_is_no_loop(film):
    other = make_sequence(
        64, frames=30, family="street", kind="handheld", speed=5.0, height=120, width=160, fps=15.0, sensor=False
    )
    frames = film[0][:30] + [replace(f, timestamp=2.0 + f.timestamp) for f in other]
    _, _, result = track(frames, replace(OPTIONS, seconds=0.5))
    assert not any(loop["from"] > 2.0 > loop["to"] for loop in result.info["loops"])


@pytest.mark.long
def test_a_wrong_loop_is_not_confirmed(film, monkeypatch):
    """A single false match, by whatever likeness, does not change the map."""
    odometry = dvo.load("small", device="cpu", loop=OPTIONS, **SHORT)
    real, calls = odometry.loops.finder.verify, []

    def once(search):
        found = yield from real(search)
        if found is not None:
            calls.append(found)
            shift = torch.tensor([len(calls) * 1.0, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
            return replace(found, measurement=found.measurement + shift)  # no two agree
        return None

    monkeypatch.setattr(odometry.loops.finder, "verify", once)
    for frame in film[0]:
        odometry.track(frame)
        if len(calls) > 3:
            break
    assert len(calls) > 1 and not odometry.loops.loops and odometry.loops.corrections == 0


@pytest.mark.long
def test_keyframes_of_a_segment_that_is_not_initialised_are_left_alone(closed):
    loops = closed[0].loops
    fresh = LoopCloser(loops.graph, replace(loops.finder, kept=[]))
    assert not fresh.advance([]) and not fresh.advance([1]) and not fresh.finder.kept


@pytest.mark.parametrize("wrong", [{"delay": -1}, {"every": 0}, {"seconds": "x"}])
def test_options_are_checked(wrong):
    with pytest.raises(DvoError, match=next(iter(wrong))):
        LoopOptions(**wrong)
    with pytest.raises(DvoError, match=next(iter(wrong))):
        dvo.load("small", loop=wrong)
