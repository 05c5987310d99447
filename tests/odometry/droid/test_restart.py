"""Another start of the dense window: a plane seen by two motions, kept solutions, windows with nothing to compare."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.ba.layer.dense import dense_patches
from dvo.ba.patch_problem import KERNEL, MAX_RESIDUAL
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3, so3
from dvo.geometry.projection import reproject
from dvo.odometry.droid.edges import neighbours_of
from dvo.odometry.droid.restart import better_solution, other_poses, take, window_problem
from dvo.odometry.droid.window import DenseWindow, FrameEdge, Keyframe

H, W = 12, 16
EXACT = GlobalBAOptions(kernel=KERNEL, max_residual=MAX_RESIDUAL, solver=LMOptions(60, 1e-3))
CAMERA = torch.tensor([13.0, 13.0, 7.5, 5.5])


def plane(poses_cw):
    """Inverse depths ``(N, H, W)`` of a tilted plane, by the normal ``n`` with ``n x = 1`` in the world."""
    y, x = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
    rays = torch.stack([(x - CAMERA[2]) / CAMERA[0], (y - CAMERA[3]) / CAMERA[1], torch.ones_like(x)], -1)
    normal = torch.tensor([0.5, 0.15, 0.8], dtype=torch.float64)
    found = []
    for pose_cw in poses_cw:
        pose_wc = se3.inverse(pose_cw)
        turned = rays @ so3.matrix(pose_wc[3:]).mT
        found.append(turned @ normal / (1 - normal @ pose_wc[:3]))
    return torch.stack(found)


@pytest.fixture
def truth():
    """Five poses around the plane, and its inverse depths."""
    steps = torch.tensor(
        [[0, 0, 0, 0, 0, 0], [0.12, 0.02, 0.01, 0.01, -0.06, 0.01], [0.22, 0.06, 0.0, 0.03, -0.1, 0.0],
         [0.3, 0.0, 0.05, 0.0, -0.17, 0.02], [0.42, -0.04, 0.02, -0.02, -0.2, 0.03]], dtype=torch.float64,
    )  # fmt: skip
    poses = se3.inverse(torch.cat([steps[:, :3], so3.exp(steps[:, 3:])], -1))
    return poses, plane(poses)


def measure(window, poses, depths):
    """Give all edges the true positions."""
    place = {id(frame): k for k, frame in enumerate(window.keyframes)}
    ends = torch.tensor([(place[id(e.source)], place[id(e.target)]) for e in window.edges])
    patches = dense_patches(depths[None]).permute(0, 1, 3, 4, 2).reshape(1, -1, 3, 1, 1)
    count = H * W
    ii, jj = (end.repeat_interleave(count) for end in ends.unbind(1))
    kk = ii * count + torch.arange(count).repeat(len(ends))
    intrinsics = CAMERA.double().expand(1, len(poses), 4)
    coords = reproject(poses[None], patches, intrinsics, ii, jj, kk).coords.reshape(len(ends), H, W, 2)
    for edge, positions in zip(window.edges, coords, strict=True):
        edge.positions, edge.confidence = positions.float(), torch.ones(H, W, 2)


def window_at(poses, depths):
    """Window with these poses and depths, and edges without measurements."""
    window = DenseWindow(None, max_edges=100, max_held=10, max_age=100)
    for k, (pose, depth) in enumerate(zip(poses.float(), depths.float(), strict=True)):
        empty = torch.zeros(1, H, W)
        colors = np.zeros((H, W, 3), np.uint8)
        window.keyframes.append(Keyframe(k, float(k), pose, depth, CAMERA, empty, empty, empty, colors, empty[0]))
    for i, j in dict.fromkeys(pair for k in range(len(poses)) for pair in neighbours_of(k, 2)):
        frames = window.keyframes
        window.edges.append(FrameEdge(frames[i], frames[j], frames[i].hidden, None))
    return window


def turns(window, poses):
    """Errors of the rotations between neighbours, degrees."""
    found = torch.stack([frame.pose_cw for frame in window.keyframes]).double()
    a, b = (se3.relative(p[:-1], p[1:]) for p in (poses, found))
    return so3.angle(so3.multiply(so3.conjugate(a[:, 3:]), b[:, 3:])).rad2deg()


def wrong_window(truth):
    """Window in the solution that begins with the other motions of the plane."""
    window = window_at(*truth)
    measure(window, *truth)
    other = other_poses(window)
    problem = window_problem(window)
    problem = problem.with_values(poses_cw=other, inverse_depths=torch.ones_like(problem.inverse_depths))
    for move_poses in (False, True):
        found = solve(problem, replace(EXACT, move_poses=move_poses))
        problem = problem.with_values(poses_cw=found.poses_cw, patches=found.patches)
    take(window, problem)
    return window


@pytest.mark.long
def test_the_wrong_motion_of_a_plane_is_left(truth):
    window = wrong_window(truth)
    assert turns(window, truth[0]).min() > 1  # it is another solution
    for edge in window.edges:
        edge.hidden, edge.age = None, 7
    taken = []

    def again():
        taken.append([(edge.positions, edge.age, edge.hidden is edge.source.hidden) for edge in window.edges])
        measure(window, *truth)

    assert better_solution(window, again, abandon=1e6)
    assert taken == [[(None, 0, True)] * len(window.edges)]  # the network measures anew
    problem = window_problem(window)
    found = solve(problem, EXACT)
    take(window, problem.with_values(poses_cw=found.poses_cw, patches=found.patches))
    assert turns(window, truth[0]).max() < 0.2


@pytest.mark.long
def test_the_right_solution_stays_as_it_was(truth):
    """Also its held edges, whatever edges the updates of the other one hold."""
    window = window_at(*truth)
    measure(window, *truth)
    for edge in window.edges:
        edge.age = 7
    window.edges, window.held = window.edges[:-2], window.edges[-2:]
    held = list(window.held)
    frames = [(f.pose_cw, f.inverse_depth, f.confidence) for f in window.keyframes]
    edges = [(e.positions, e.confidence, e.hidden, e.age) for e in window.edges]
    calls = []

    def again():
        calls.append(len(window.held))
        measure(window, *truth)
        window.held, window.edges = window.edges[:3], window.edges[3:]

    assert not better_solution(window, again, float("inf"))
    assert calls == [0]  # the other one was tried
    assert window.held == held
    for frame, kept in zip(window.keyframes, frames, strict=True):
        assert all(a is b for a, b in zip((frame.pose_cw, frame.inverse_depth, frame.confidence), kept, strict=True))
    for edge, kept in zip(window.edges, edges, strict=True):
        assert all(a is b for a, b in zip((edge.positions, edge.confidence, edge.hidden, edge.age), kept, strict=True))


@pytest.mark.long
def test_a_solution_that_is_much_worse_is_not_measured(truth):
    window = window_at(*truth)
    measure(window, *truth)
    assert not better_solution(window, lambda: pytest.fail("measured"))  # the present cost is next to nothing


def test_two_keyframes_and_missing_edges_have_no_other_start(truth):
    poses, depths = truth
    pair = window_at(poses[:2], depths[:2])
    measure(pair, poses[:2], depths[:2])
    assert not better_solution(pair, lambda: pytest.fail("measured"), float("inf"))
    window = window_at(poses, depths)
    measure(window, poses, depths)
    window.edges = [e for e in window.edges if (e.source.number, e.target.number) != (1, 2)]
    assert not better_solution(window, lambda: pytest.fail("measured"), float("inf"))
