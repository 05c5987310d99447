"""Corrections of a graph by similarities."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.geometry import se3, sim3
from dvo.geometry.projection import reproject
from dvo.map.correction import apply_similarities, move_window, set_solution, similarity_between
from tests.support.archived_walk import archived_walk

TANGENT = st.lists(st.floats(-1, 1), min_size=7, max_size=7).map(lambda xi: torch.tensor(xi, dtype=torch.float64))


def kept(graph):
    return np.array([keyframe.identifier for keyframe in graph.archive if keyframe.anchor is None])


def measured(graph):
    """Positions of all archived measurements under the present poses and depths."""
    p = graph.problem()
    found = reproject(p.poses_cw[None], p.patches[None], p.intrinsics[None], p.ii, p.jj, p.kk)
    return found.coords[0, :, 0, 0]


@settings(max_examples=10, deadline=None)
@given(TANGENT)
def test_a_similarity_of_the_world_changes_no_measurement(xi):
    graph, _ = archived_walk(frames=12, dropped=(4, 5, 9))
    before, rows = measured(graph), graph.log.trajectory()
    change = sim3.exp(xi)
    identifiers = kept(graph)
    moved = sim3.compose(sim3.from_se3(graph.poses_cw(identifiers)), sim3.inverse(change))
    apply_similarities(graph, identifiers, moved)
    near = (before.abs().max(-1).values < 100) & torch.isfinite(measured(graph)).all(-1)  # pixels; depths are float32
    assert near.sum() > 100 and torch.allclose(measured(graph)[near], before[near], atol=2e-3)
    after = graph.log.trajectory()
    expected = sim3.act(change, torch.from_numpy(rows.positions)).numpy()
    assert np.allclose(after.positions, expected, atol=1e-6)  # quaternions of the walk are float32
    assert np.array_equal(after.timestamps, rows.timestamps)
    assert graph.archive[5].anchor == 4 and graph.archive[4].anchor == 3


def test_a_keyframe_takes_its_dropped_ones_and_its_scale_along():
    graph, _ = archived_walk(frames=8, dropped=(3, 4))
    identifiers = kept(graph)
    old = {k.identifier: (k.inverse_depth.copy(), k.pose_cw.copy()) for k in graph.archive}
    poses = graph.poses_cw(identifiers)
    similarities = sim3.from_se3(poses)
    row = identifiers.tolist().index(2)
    similarities[row, :3] *= 2.0
    similarities[row, 7] = 2.0  # the unit of keyframe 2 was half of that of the others
    apply_similarities(graph, identifiers, similarities)
    for k in (2, 3, 4):
        assert np.allclose(graph.archive[k].inverse_depth, 2 * old[k][0])
    assert np.allclose(graph.archive[5].inverse_depth, old[5][0])
    assert np.allclose(graph.archive[2].pose_cw, old[2][1])  # the same place: S / s
    for k in (3, 4):
        assert np.allclose(graph.archive[k].pose_cw[:3], old[k][1][:3] / 2)


def test_frames_relative_to_a_keyframe_are_rescaled():
    graph, _ = archived_walk(frames=6)
    graph.log.add(9.0)
    pose = graph.poses_cw(np.array([2]))[0].numpy().copy()
    pose[:3] += [0.1, 0.0, 0.0]
    graph.log.place(6, 2, pose)
    before = graph.log.frames[6].relative.copy()
    graph.log.rescale({2: 4.0, 3: 2.0})
    assert np.allclose(graph.log.frames[6].relative[:3], before[:3] / 4)
    assert np.allclose(graph.log.frames[6].relative[3:], before[3:])


@settings(max_examples=10, deadline=None)
@given(TANGENT)
def test_the_window_moves_with_a_keyframe(xi):
    graph, _ = archived_walk(frames=6, archived=False)
    window = graph.window
    window.poses_cw, window.patches = window.poses_cw.double(), window.patches.double()
    reference = se3.exp(0.1 * torch.ones(6, dtype=torch.float64))
    change = sim3.exp(xi)

    def seen():
        args = window.poses_cw[None], window.patches[None], window.intrinsics.double()[None]
        return reproject(*args, window.ii, window.jj, window.kk).coords

    before, centres = seen(), se3.inverse(window.poses_cw)[:, :3]
    move_window(graph, reference, sim3.compose(sim3.from_se3(reference), sim3.inverse(change)))
    assert torch.allclose(seen(), before, atol=1e-6)
    assert torch.allclose(se3.inverse(window.poses_cw)[:, :3], sim3.act(change, centres), atol=1e-6)


def test_keyframes_dropped_from_the_window_keep_their_place_in_it():
    """Their unit is that of the window: a scale of it leaves the shape of the trajectory as it is."""
    graph, _ = archived_walk(frames=8, dropped=(3, 4), archived=False)
    window = graph.window
    for frame, pose in zip(window.frames, window.poses_cw.double().numpy(), strict=True):
        graph.log.set_pose(frame.identifier, pose)
    before, depth = graph.log.trajectory().positions, graph.archive[4].inverse_depth.copy()
    reference = window.poses_cw[0].double()
    move_window(graph, reference, sim3.compose(sim3.from_se3(reference), sim3.exp(torch.tensor([0.0] * 6 + [0.7]))))
    for frame, pose in zip(window.frames, window.poses_cw.double().numpy(), strict=True):
        graph.log.set_pose(frame.identifier, pose)
    after = graph.log.trajectory().positions
    ratio = np.linalg.norm(np.diff(after, axis=0), axis=1) / np.linalg.norm(np.diff(before, axis=0), axis=1)
    assert np.allclose(ratio, np.exp(-0.7), atol=1e-4)
    assert np.allclose(graph.archive[4].inverse_depth, depth * np.exp(0.7))


def half_archived(dropped=(4, 5, 9)):
    """A walk whose later half is in the window: keyframe 9 has left that, and is relative to one in it."""
    graph, _ = archived_walk(frames=14, dropped=dropped, archived=False)
    for _ in range(5):
        graph.archive_oldest()
    return graph


def solved(graph):
    """Identifiers, poses and depths of all keyframes, as they are."""
    whole = graph.copy()
    whole.archive_window()
    identifiers = np.array([keyframe.identifier for keyframe in whole.archive])
    return identifiers, whole.poses_cw(identifiers), np.stack([whole.archive[k].inverse_depth for k in identifiers])


def moved_by(change, poses_cw, depths):
    similarities = sim3.compose(sim3.from_se3(poses_cw), sim3.inverse(change))
    return torch.cat([similarities[:, :3] / similarities[:, 7:], similarities[:, 3:7]], 1), depths / float(change[7])


@settings(max_examples=10, deadline=None)
@given(TANGENT)
def test_map_and_window_take_a_solution(xi):
    graph, change = half_archived(), sim3.exp(0.5 * xi)
    identifiers, poses_cw, depths = solved(graph)
    poses_cw, depths = moved_by(change, poses_cw, depths)
    moved = set_solution(graph, 0, identifiers, poses_cw, depths)
    again, found, inverse = solved(graph)
    assert again.tolist() == identifiers.tolist() and len(graph.window) == 6
    assert torch.allclose(found[:, :3], poses_cw[:, :3], atol=1e-4)
    assert torch.allclose((found[:, 3:] * poses_cw[:, 3:]).sum(1).abs(), torch.ones(14).double(), atol=1e-6)
    assert np.allclose(inverse, depths, rtol=1e-5)
    assert np.allclose(list(moved.units.values()), 1 / float(change[7]), rtol=1e-5) and len(moved.units) == 11
    (carried,) = moved.worlds
    assert carried.window and carried.time == graph.window.frames[-1].timestamp
    assert torch.allclose(carried.change[:3], change[:3], atol=1e-3)
    assert torch.allclose(carried.change[7], change[7], rtol=1e-5)


def test_keyframes_without_a_solution_go_with_their_neighbours():
    """Of a solution of the middle alone, earlier and later ones keep their place beside it."""
    graph, change = half_archived(), sim3.exp(torch.tensor([0.3, -0.2, 0.1, 0.2, 0.1, -0.3, 0.4], dtype=torch.float64))
    identifiers, poses_cw, depths = solved(graph)
    wanted = moved_by(change, poses_cw, depths)
    middle = slice(3, 11)
    set_solution(graph, 0, identifiers[middle], wanted[0][middle], wanted[1][middle])
    _, found, inverse = solved(graph)
    assert torch.allclose(found[:, :3], wanted[0][:, :3], atol=1e-3) and np.allclose(inverse, wanted[1], rtol=1e-5)
    assert not set_solution(graph, 7, identifiers[middle], wanted[0][middle], wanted[1][middle])


def test_a_keyframe_that_a_solution_moves_alone_takes_its_dropped_ones_along():
    graph = half_archived(dropped=(9,))
    identifiers, poses_cw, depths = solved(graph)
    row = identifiers.tolist().index(8)
    alone = poses_cw[row : row + 1] + torch.tensor([0.5, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    set_solution(graph, 0, identifiers[row : row + 1], alone, depths[row : row + 1])
    _, found, _ = solved(graph)
    kept = se3.relative(poses_cw[row], poses_cw[row + 1])
    assert torch.allclose(se3.relative(found[row], found[row + 1])[:3], kept[:3], atol=1e-6)
    assert torch.allclose(found[row, :3], alone[0, :3], atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(TANGENT, TANGENT)
def test_similarity_between_two_worlds(xi, change):
    """A keyframe found in another world: the similarity takes every pose there."""
    pose, world = se3.exp(xi[:6]), sim3.exp(change)
    there = sim3.act_on_pose(world, se3.inverse(pose)[None])[0]
    found = similarity_between(pose, se3.inverse(there), float(world[7]))
    points = torch.randn(5, 3, dtype=torch.float64)
    assert torch.allclose(sim3.act(found, points), sim3.act(world, points), atol=1e-8)


def test_worlds_join():
    graph, _ = archived_walk(frames=4)
    graph.begin_segment(4)
    graph.begin_segment(7)
    assert [graph.world_of(k) for k in range(3)] == [0, 1, 2]
    graph.join(2, 1)
    assert [graph.world_of(k) for k in range(3)] == [0, 1, 1]
    graph.join(2, 0)
    assert [graph.world_of(k) for k in range(3)] == [0, 0, 0]
    assert len(graph.members(2)) == len(graph.members(0)) == 4
