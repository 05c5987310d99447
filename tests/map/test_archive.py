"""Archive of a keyframe graph: its memory bound, its measurements, and global bundle adjustment from it."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dvo.ba.sparse.global_adjust import GlobalBAOptions, global_bundle_adjust
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.map import keyframe_graph
from dvo.map.archive import Archive, ArchiveConfig, ArchivedKeyframe, ArrayStorage
from dvo.map.features import FeatureCache
from dvo.map.keyframe_graph import RELEASE_INTERVAL, KeyframeGraph
from dvo.map.measurements import ArchivedEdges, pack_edges
from dvo.map.window import Keyframe
from dvo.nets.patch.patchifier import patch_coordinates

M = 3
KINDS = st.sampled_from([np.uint8, np.int16, np.float16, np.float32, np.float64])
ARRAYS = KINDS.flatmap(lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=9)))


def keyframe(identifier, size=1000, anchor=None):
    image = np.zeros(size, np.uint8)
    pose = np.array([identifier, 0, 0, 0, 0, 0, 1.0])
    return ArchivedKeyframe(
        identifier, 0.1 * identifier, np.ones(4, np.float32), pose, anchor, np.zeros((M, 2), np.float32),
        np.ones(M, np.float32), np.zeros((M, 3), np.uint8), np.zeros((M, 4, 3, 3), np.float16),
        np.zeros((M, 5), np.float16), image,
    )  # fmt: skip


def edges(count, identifier):
    one = np.full(count, identifier, np.int32)
    return ArchivedEdges(one, np.zeros(count, np.int16), one + 1, np.zeros((count, 2), np.float32),
                         np.ones((count, 2), np.float16))  # fmt: skip


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 200)), max_size=30), st.integers(0, 20_000))
@settings(max_examples=40, deadline=None)
def test_memory_stays_within_the_bound_and_is_counted_exactly(sizes, bound):
    archive = Archive(ArchiveConfig(max_bytes=bound))
    for number, (image, count) in enumerate(sizes):
        archive.add_edges(edges(count, number))
        archive.add(keyframe(number, image))
        held = sum(k.feature_bytes + k.patch_bytes for k in archive) + sum(part.nbytes for part in archive.parts)
        assert archive.nbytes == held <= bound
    assert len(archive) == len(sizes)  # poses are never released
    assert all(k.pose_cw[0] == k.identifier for k in archive)


def test_arrays_are_copied():
    given_ = replace(keyframe(0), measured=np.ones((M, 2), np.float32))
    archive, later = Archive(), np.full((M, 2), 2, np.float32)
    archive.add(given_)
    for array in (given_.measured, given_.inverse_depth, given_.matching, given_.jpeg):
        array[...] = 9
    kept = archive[0]
    assert (kept.measured == 1).all() and (kept.inverse_depth == 1).all() and not kept.matching.any()
    archive.set_measured(0, later)
    later[...] = 9
    assert (archive[0].measured == 2).all() and not kept.jpeg.any()


def test_features_go_first_then_edges_then_patches_oldest_first():
    one = keyframe(0)
    both = one.feature_bytes + one.patch_bytes
    archive = Archive(ArchiveConfig(max_bytes=2 * both + pack_edges(edges(10, 0)).nbytes))
    for number in range(2):
        archive.add(keyframe(number))
    archive.add_edges(edges(10, 0))
    archive.add(keyframe(2))
    assert archive[0].jpeg is None and archive[0].matching is None and len(archive[0].inverse_depth) == M
    assert archive[2].jpeg is not None and len(archive.edges()) == 10


def test_settings_out_of_range():
    with pytest.raises(DvoError, match="jpeg_quality"):
        ArchiveConfig(jpeg_quality=0)


def scene(frames=6, seed=0):
    """Poses and points, and the graph of a tracker that saw them without error."""
    g = torch.Generator().manual_seed(seed)
    poses = se3.exp(0.05 * torch.randn(frames, 6, generator=g, dtype=torch.float64)).float()
    centres = torch.randint(4, 36, (1, frames, M, 2), generator=g)
    depth = 0.5 + torch.rand(1, frames * M, generator=g)
    patches = patch_coordinates(centres, depth, 3)
    intrinsics = torch.tensor([40.0, 40.0, 20.0, 20.0])
    graph = KeyframeGraph(M, 3, 4, torch.device("cpu"))
    image = np.full((40, 40, 3), (200, 20, 90), np.uint8)
    for i in range(frames):
        part = slice(i * M, (i + 1) * M)
        colors = torch.full((M, 3), i, dtype=torch.uint8)
        frame = Keyframe(i, 0.1 * i, i, torch.randn(M, 8, 3, 3), torch.randn(M, 4), colors, intrinsics, image)
        graph.window.append(frame, poses[i], patches[0, part])
        graph.log.add(0.1 * i, i)
    kk = torch.arange(frames * M).repeat_interleave(frames)
    jj = torch.arange(frames).repeat(frames * M)
    kk, jj = kk[kk // M != jj], jj[kk // M != jj]
    graph.window.connect(kk, jj)
    seen = reproject(poses[None], patches, intrinsics.expand(1, frames, 4), kk // M, jj, kk).coords
    graph.window.targets = seen[0, :, 1, 1]
    graph.window.weights = torch.full((len(kk), 2), 0.5)
    return graph, poses


def residual(problem):
    state = (x[None] for x in (problem.poses_cw, problem.patches, problem.intrinsics))
    found = reproject(*state, problem.ii, problem.jj, problem.kk).coords
    return (found[0, :, 0, 0] - problem.targets).abs().max()


def test_everything_that_left_is_a_problem_that_bundle_adjustment_can_take():
    """A keyframe dropped in the middle, edges that aged, the rest archived in order: every measurement is there once,
    and agrees with the archived poses."""
    graph, poses = scene()
    count = len(graph.window.kk)
    graph.drop(2)
    graph.keep_edges(graph.window.ii > 0)
    while len(graph.window):
        graph.archive_oldest()
    assert len(graph.archive) == 6 and graph.archive[2].anchor == 1
    problem = graph.problem()
    assert len(problem.kk) == count and problem.identifiers.tolist() == [0, 1, 2, 3, 4, 5]
    torch.testing.assert_close(problem.poses_cw.float(), poses, atol=1e-5, rtol=1e-4)
    assert residual(problem) < 1e-3
    kept = graph.problem(dropped=False)
    assert kept.identifiers.tolist() == [0, 1, 3, 4, 5] and residual(kept) < 1e-3
    assert len(kept.kk) == 5 * M * 4
    # The frame of the dropped keyframe still has its row.
    assert len(graph.log.trajectory()) == 6


def test_a_frame_whose_place_the_window_decides_is_no_member_yet():
    """An aligned frame is relative to the newest keyframe, which is dropped later and then relative to another one."""
    graph, poses = scene()
    none = np.zeros(0, np.int64), np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    graph.log.add(0.6).place(6, 0)
    graph.attach(6, 0.6, poses[5].double().numpy(), *none)
    graph.drop(5)
    graph.archive_oldest()
    assert [frame.identifier for frame in graph.members(0)] == graph.problem().identifiers.tolist() == [0]
    while len(graph.window):
        graph.archive_oldest()
    assert graph.problem().identifiers.tolist() == [0, 1, 2, 3, 4, 5, 6]


@pytest.mark.long
def test_a_global_adjustment_of_the_archive_moves_frames_and_points_back():
    """Archived poses are disturbed; bundle adjustment of everything archived finds them again."""
    graph, poses = scene()
    while len(graph.window):
        graph.archive_oldest()
    generator = torch.Generator().manual_seed(3)
    for identifier in range(2, 6):
        noise = 0.02 * torch.randn(6, generator=generator, dtype=torch.float64)
        moved = se3.retract(torch.from_numpy(graph.archive[identifier].pose_cw), noise)
        graph.correct(identifier, moved.numpy())
    problem = graph.problem()
    measured = (problem.targets, problem.weights, problem.ii, problem.jj, problem.kk)
    found = global_bundle_adjust(
        problem.poses_cw, problem.patches, problem.intrinsics, *measured, GlobalBAOptions(fixed=2)
    )
    assert found.cost < 1e-3 * found.initial_cost
    depth = found.patches[:, 2, 0, 0].view(-1, M).numpy()
    for row, identifier in enumerate(problem.identifiers.tolist()):
        graph.correct(identifier, found.poses_cw[row].numpy(), depth[row])
    back = np.array([keyframe.pose_cw for keyframe in graph.archive])
    np.testing.assert_allclose(back, poses.double().numpy(), atol=2e-3)
    np.testing.assert_allclose(graph.log.trajectory().poses_wc, se3.inverse(torch.from_numpy(back)).numpy(), atol=1e-6)


def test_points_are_anchored_on_their_keyframes():
    graph, _ = scene()
    while len(graph.window):
        graph.archive_oldest()
    before, colors = graph.points()
    pose = graph.archive[3].pose_cw
    shift = np.array([0.0, 0, 0, 0, 0, 0, 1])
    moved = se3.compose(torch.from_numpy(pose), torch.from_numpy(shift + [-1, 0, 0, 0, 0, 0, 0])).numpy()
    graph.correct(3, moved)
    after, _ = graph.points()
    of_three = colors[:, 0] == 3
    np.testing.assert_allclose(after[of_three], before[of_three] + [1, 0, 0], atol=1e-4)
    np.testing.assert_array_equal(after[~of_three], before[~of_three])
    row = graph.log.trajectory().poses_wc[3]
    np.testing.assert_allclose(row[:3], se3.inverse(torch.from_numpy(moved)).numpy()[:3], atol=1e-9)


def test_edges_without_an_update_and_discarded_frames_leave_no_measurement():
    graph, _ = scene()
    graph.window.weights[:] = 0
    graph.keep_edges(torch.zeros(len(graph.window.kk), dtype=torch.bool))
    assert len(graph.archive.edges()) == 0
    graph, _ = scene()
    graph.discard(5)
    while len(graph.window):
        graph.archive_oldest()
    assert len(graph.archive) == 5 and 5 not in graph.archive.edges().target


def test_feature_maps_are_computed_again_and_forgotten():
    graph, _ = scene()
    while len(graph.window):
        graph.archive_oldest()
    asked = []

    def encode(image):
        asked.append(image.shape)
        assert np.abs(image.astype(int) - [200, 20, 90]).max() < 12  # JPEG
        return torch.zeros(1)

    cache = FeatureCache(encode, capacity=2)
    for identifier in (0, 1, 0, 2, 0, 1):
        assert cache.maps(graph.archive[identifier]) is not None
    assert len(cache) == 2 and asked == [(40, 40, 3)] * 4
    assert cache.maps(replace(graph.archive[3], jpeg=None)) is None
    with pytest.raises(DvoError, match="capacity"):
        FeatureCache(encode, capacity=0)


def test_a_frame_dropped_as_still_has_the_pose_of_its_keyframe_until_it_is_corrected():
    graph, poses = scene()
    graph.drop(3, still=True)
    graph.drop(3)  # the frame after it
    while len(graph.window):
        graph.archive_oldest()
    rows = graph.log.trajectory().poses_wc
    np.testing.assert_array_equal(rows[3], rows[2])
    assert not np.allclose(rows[4], rows[2])
    graph.correct(3, poses[3].double().numpy())
    found = torch.from_numpy(graph.log.trajectory().poses_wc[3])
    torch.testing.assert_close(se3.inverse(found).float(), poses[3], atol=1e-6, rtol=1e-5)
    assert graph.archive[3].anchor == 2


def test_frames_carried_by_a_lost_keyframe_are_lost_with_it():
    graph, _ = scene()
    graph.drop(1)
    graph.log.lose(graph.discard(0).identifier, "another scene")
    while len(graph.window):
        graph.archive_oldest()
    assert [record.lost for record in graph.log.frames] == [True, True, False, False, False, False]
    assert [frame.identifier for frame in graph.members(0)] == [2, 3, 4, 5]  # the anchor of 1 is not archived
    assert graph.problem().identifiers.tolist() == [2, 3, 4, 5]


@pytest.mark.long
@given(st.lists(ARRAYS, max_size=12), st.sampled_from([64, 256, 4096]))
def test_arrays_are_kept_as_they_are(arrays, chunk):
    storage = ArrayStorage(chunk)
    kept = [storage.keep(array) for array in arrays]
    for array, copy in zip(arrays, kept, strict=True):
        assert copy.dtype == array.dtype and copy.flags.c_contiguous
        np.testing.assert_array_equal(copy, array)
    for array, copy in zip(arrays, kept, strict=True):  # none shares memory with another one, or with its original
        copy[...] = 0
        array[...] = 1
    assert not any(copy.any() for copy in kept)


def test_an_array_that_is_not_contiguous_is_copied_in_order():
    array = np.arange(12, dtype=np.float32).reshape(3, 4)[:, ::2].T
    np.testing.assert_array_equal(ArrayStorage().keep(array), array)


def test_a_mapping_is_released_with_its_last_array():
    storage = ArrayStorage(chunk=1024)
    first, second = storage.keep(np.zeros(512, np.uint8)), storage.keep(np.zeros(512, np.uint8))
    base = first
    while isinstance(base, np.ndarray) and base.base is not None:
        base = base.base
    mapping = weakref.ref(base.obj if isinstance(base, memoryview) else base)
    del base
    storage.keep(np.zeros(8, np.uint8))  # begins the next mapping
    del first
    gc.collect()
    assert mapping() is not None
    del second
    gc.collect()
    assert mapping() is None


def test_memory_is_released_after_a_number_of_frames_kept_or_dropped(monkeypatch):
    calls = []
    monkeypatch.setattr(keyframe_graph, "release_free_memory", lambda: calls.append(len(graph.archive)))
    graph, m = KeyframeGraph(2, 3, 5, torch.device("cpu")), 2
    pose, patches = torch.tensor([0, 0, 0, 0, 0, 0, 1.0]), torch.ones(m, 3, 3, 3)
    features = torch.zeros(m, 4, 3, 3), torch.zeros(m, 5), torch.zeros(m, 3, dtype=torch.uint8), torch.ones(4)
    for number in range(3 * RELEASE_INTERVAL):
        graph.window.append(Keyframe(number, 0.1 * number, 0, *features), pose, patches)
        if number % 3 == 1:
            graph.drop(1)
        elif len(graph.window) > 1:
            graph.archive_oldest()
    assert calls == [RELEASE_INTERVAL, 2 * RELEASE_INTERVAL]
