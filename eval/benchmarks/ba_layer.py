"""Benchmark of the BA layer: ``python -m eval.benchmarks.ba_layer [--batch 1 4] [--device cpu]``.

Prints milliseconds of processor time (CPU) or wall time for two iterations, forward alone and with backward, the
fastest of several runs, and the ratio to the dense reference implementation in :mod:`dvo.ba.layer.reference`. On the
CPU two more lines follow, each of two programs that take turns: two iterations on a window of 1,632 edges by compiled
kernels and by their plain twin; and a problem of 4,800 observations of points, solved from the same start to the same
cost by :func:`dvo.ba.points.solve_points` and, with pycolmap installed, by Ceres (its problem is built beforehand).
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dvo.ba.bal import PointProblem
from dvo.ba.edges import plan_edges
from dvo.ba.layer.layer import bundle_adjust
from dvo.ba.layer.reference import bundle_adjust_reference
from dvo.ba.options import BAOptions
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.points import residuals, solve_points
from dvo.ba.solve import solve
from dvo.core.command_line import OneLineParser
from dvo.core.kernels import CHOICES, VARIABLE
from dvo.geometry import se3, so3
from dvo.geometry.projection import reproject


def training_clip(batch: int, frames: int, per_frame: int, device: torch.device) -> tuple[list[Tensor], list[Tensor]]:
    """Input of ``bundle_adjust`` as in training: every patch has an edge into every other frame.

    Args:
        batch, frames, per_frame: numbers of clips, frames, and patches per frame.
        device: of the result.

    Returns:
        Poses ``T_cw (B, N, 7)``, patches ``(B, K, 3, 3, 3)``, intrinsics ``(B, N, 4)``, targets ``(B, E, 2)`` in
        feature pixels and weights ``(B, E, 2)``; and ``ii, jj, kk (E,)``.
    """
    generator = torch.Generator().manual_seed(0)
    count = frames * per_frame
    poses = se3.exp(0.05 * torch.randn(batch, frames, 6, generator=generator))
    centres = torch.rand(batch, count, 2, generator=generator) * torch.tensor([40.0, 30.0])
    patches = torch.cat((centres, 0.3 + torch.rand(batch, count, 1, generator=generator)), -1)[..., None, None]
    patches = patches.expand(-1, -1, -1, 3, 3)
    intrinsics = torch.tensor([35.0, 35, 20, 15]).expand(batch, frames, 4)
    kk = torch.arange(count).repeat_interleave(frames)
    ii, jj = kk // per_frame, torch.arange(frames).repeat(count)
    other = ii != jj
    ii, jj, kk = ii[other], jj[other], kk[other]
    targets = reproject(poses, patches, intrinsics, ii, jj, kk).coords[:, :, 1, 1]
    start = se3.retract(poses, 0.02 * torch.randn(batch, frames, 6, generator=generator))
    weights = torch.rand(targets.shape, generator=generator)
    floats = (start, patches, intrinsics, targets, weights)
    return [x.to(device) for x in floats], [x.to(device) for x in (ii, jj, kk)]


def fastest(run: Callable[[], None], device: torch.device, repeats: int) -> float:
    """Shortest time of several runs.

    Args:
        run: the call to time.
        device: synchronised after each run.
        repeats: number of runs.

    Returns:
        Milliseconds, of processor time on the CPU and wall time elsewhere.
    """
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    best = float("inf")
    for _ in range(repeats):
        start = clock()
        run()
        if device.type != "cpu":
            torch.accelerator.synchronize(device)
        best = min(best, clock() - start)
    return best * 1e3


def window(edges: int, frames: int = 9, per_frame: int = 24) -> PatchProblem:
    """A problem as in tracking.

    Args:
        edges: number of edges.
        frames, per_frame: numbers of frames, and of patches per frame.

    Returns:
        The problem, a batch of one.
    """
    floats, indices = training_clip(1, frames, per_frame, torch.device("cpu"))
    poses_cw, patches, intrinsics, targets, weights = floats
    ii, jj, kk = (x[:edges] for x in indices)
    return PatchProblem(poses_cw, patches, intrinsics, targets[:, :edges], weights[:, :edges], ii, jj, kk)


def kernels_and_twin(edges: int, repeats: int) -> tuple[float, float]:
    """Wall time of a window by kernels and by the plain twin, in turns.

    Args:
        edges: of the window.
        repeats: number of runs of each.

    Returns:
        Milliseconds of the fastest run of each.
    """
    given, chosen = window(edges), os.environ.get(VARIABLE)
    best = dict.fromkeys(CHOICES, float("inf"))
    with torch.inference_mode():
        for _ in range(repeats):
            for choice in CHOICES:
                os.environ[VARIABLE] = choice
                start = time.perf_counter()
                solve(given, BAOptions(check=False, bounds=(160, 120)))
                best[choice] = min(best[choice], time.perf_counter() - start)
    os.environ.pop(VARIABLE)
    if chosen is not None:
        os.environ[VARIABLE] = chosen
    numba, twin = (best[choice] * 1e3 for choice in CHOICES)
    return numba, twin


def point_problem(cameras: int = 12, points: int = 400) -> PointProblem:
    """Points seen by all cameras, with a noise of half a pixel, and a start that is off.

    Args:
        cameras, points: their numbers.

    Returns:
        The problem, in double precision.
    """
    generator = torch.Generator().manual_seed(0)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    poses = se3.exp(0.1 * randn(cameras, 6))
    true = 2 * randn(points, 3) + torch.tensor([0.0, 0.0, 10.0], dtype=torch.float64)
    camera = torch.arange(cameras).repeat_interleave(points)
    point = torch.arange(points).repeat(cameras)
    intrinsics = torch.tensor([500.0, 500, 320, 240], dtype=torch.float64).expand(cameras, 4).contiguous()
    nothing = torch.zeros(len(camera), 2, dtype=torch.float64)
    exact = PointProblem(poses, intrinsics, nothing[:cameras], true, camera, point, nothing)
    measured = -residuals(exact) + 0.5 * randn(len(camera), 2)
    start = torch.cat((poses[:1], se3.retract(poses[1:], 0.02 * randn(cameras - 1, 6))))
    return PointProblem(start, intrinsics, nothing[:cameras], true + 0.1 * randn(points, 3), camera, point, measured)


def built_for_ceres(problem: PointProblem) -> tuple[Any, Any]:
    """The problem as pycolmap has it: poses but the first, and points, are unknown.

    Args:
        problem: without radial distortion, with the same intrinsics for all cameras.

    Returns:
        Adjuster, whose ``solve()`` runs Ceres on one thread, and the reconstruction that it changes.
    """
    colmap = importlib.import_module("pycolmap")
    found = colmap.Reconstruction()
    parameters = problem.intrinsics[0].tolist()
    found.add_camera_with_trivial_rig(
        colmap.Camera(model="PINHOLE", width=640, height=480, params=parameters, camera_id=1)
    )
    tracks: list[list[tuple[int, int]]] = [[] for _ in problem.points]
    config = colmap.BundleAdjustmentConfig()
    rotations = so3.matrix(problem.poses_cw[:, 3:]).numpy()
    for c, pose in enumerate(problem.poses_cw.numpy()):
        at = (problem.camera == c).nonzero()[:, 0]
        image = colmap.Image(name=f"{c}", keypoints=problem.pixels[at].numpy(), camera_id=1, image_id=c + 1)
        found.add_image_with_trivial_frame(image, colmap.Rigid3d(colmap.Rotation3d(rotations[c]), pose[:3]))
        for place, k in enumerate(problem.point[at].tolist()):
            tracks[k].append((c + 1, place))
        config.add_image(c + 1)
    for k, track in enumerate(tracks):
        elements = [colmap.TrackElement(*element) for element in track]
        found.add_point3D(problem.points[k].numpy(), colmap.Track(elements=elements))
    config.set_constant_cam_intrinsics(1)
    config.set_constant_rig_from_world_pose(found.image(1).frame_id)
    options = colmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 100
    return colmap.create_default_bundle_adjuster(options, config, found), found


def points_and_ceres(repeats: int) -> tuple[float, float, float, float]:
    """Wall time of a point problem by this package and by Ceres, in turns.

    Args:
        repeats: number of runs of each.

    Returns:
        Milliseconds of the fastest run of each, and the costs (half the sum of squared pixels) reached.
    """
    problem = point_problem()
    best, costs = [float("inf")] * 2, [0.0] * 2
    for _ in range(repeats):
        start = time.perf_counter()
        solution = solve_points(problem, fixed=1)
        best[0], costs[0] = min(best[0], time.perf_counter() - start), solution.cost
        adjuster, found = built_for_ceres(problem)
        start = time.perf_counter()
        adjuster.solve()
        best[1] = min(best[1], time.perf_counter() - start)
        matrices = [
            torch.from_numpy(found.image(c + 1).cam_from_world().matrix()) for c in range(len(problem.poses_cw))
        ]
        points = [torch.from_numpy(found.point3D(k).xyz) for k in sorted(found.point3D_ids())]
        theirs = problem.moved(se3.from_matrix(torch.stack(matrices)), torch.stack(points))
        costs[1] = 0.5 * float(residuals(theirs).square().sum())
    return best[0] * 1e3, best[1] * 1e3, costs[0], costs[1]


def main() -> None:
    """Run the benchmark and print a table."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--patches", type=int, default=24, help="per frame")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    print(f"{'batch':>5} {'edges':>6} {'pass':>18} {'layer ms':>9} {'twin ms':>9} {'ratio':>6}")
    for batch in options.batch:
        floats, edges = training_clip(batch, options.frames, options.patches, device)
        ii, jj, kk = edges
        plan = plan_edges(ii, jj, kk, options.frames, options.frames * options.patches)
        for backward in (False, True):
            leaves = [x.clone().requires_grad_(backward) for x in floats]

            def layer(leaves: list[Tensor] = leaves, backward: bool = backward) -> None:
                a, b, c, d, e = leaves
                result = bundle_adjust(a, b, c, d, e, ii, jj, kk, plan=plan)  # noqa: B023 (called in this iteration)
                if backward:
                    (result.poses_cw.sum() + result.patches.sum()).backward()

            def twin(leaves: list[Tensor] = leaves, backward: bool = backward) -> None:
                a, b, c, d, e = leaves
                result = bundle_adjust_reference(a, b, c, d, e, ii, jj, kk)  # noqa: B023
                if backward:
                    (result.poses_cw.sum() + result.patches.sum()).backward()

            ours, theirs = fastest(layer, device, 30), fastest(twin, device, 3)
            name = "forward, backward" if backward else "forward"
            print(f"{batch:5d} {len(ii):6d} {name:>18} {ours:9.2f} {theirs:9.2f} {theirs / ours:6.1f}")
    if device.type != "cpu":
        return
    ours, theirs = kernels_and_twin(1632, 100)
    print(f"window of 1632 edges: kernels {ours:.2f} ms, twin {theirs:.2f} ms, ratio {theirs / ours:.1f}")
    if importlib.util.find_spec("pycolmap") is None:
        print("4800 observations of points: no Ceres to compare with (pip install pycolmap)")
        return
    ours, theirs, cost, their_cost = points_and_ceres(5)
    same = abs(cost - their_cost) <= 1e-3 * their_cost
    print(f"4800 observations of points: dvo {ours:.1f} ms, Ceres {theirs:.1f} ms, ratio {theirs / ours:.2f}; "
          f"cost {cost:.1f} and {their_cost:.1f}{'' if same else ', which differ by more than 0.1 %'}")  # fmt: skip


if __name__ == "__main__":
    main()
