"""Time and peak memory of global bundle adjustment: ``python -m eval.benchmarks.global_ba [--frames 1000]``.

A synthetic camera moves along two laps of a circle; patches have edges into the neighbouring frames and, between the
laps, into the frames around the same place. Targets have noise and outliers; the initial poses drift. Prints edges,
seconds, peak memory, and cost and position error before and after.
"""

from __future__ import annotations

import math
import resource
import time

import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.command_line import OneLineParser
from dvo.geometry import se3, so3
from dvo.geometry.projection import reproject

WIDTH, HEIGHT, FOCAL = 320.0, 240.0, 260.0
RADIUS = 10.0


def make_graph(
    frames: int = 1000,
    per_frame: int = 48,
    reach: int = 11,
    loop_reach: int = 3,
    noise: float = 0.5,
    wrong: float = 0.03,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> tuple[PatchProblem, Tensor]:
    """Two laps of a circle with the camera facing outwards.

    Args:
        frames: number of frames of both laps together.
        per_frame: patches of each frame.
        reach: largest distance in frames of the edges of a patch.
        loop_reach: largest distance in frames of its edges around the frame one lap away.
        noise: standard deviation of the targets, pixels.
        wrong: fraction of targets that are uniform over the image.
        seed: of the random numbers.
        dtype: of all tensors.

    Returns:
        The problem, with a drifting initial estimate, and the true poses ``(N, 7)``, world to camera.
    """
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    lap = frames // 2
    angle = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / lap)
    zero = torch.zeros_like(angle)
    centre = torch.stack((RADIUS * angle.sin(), 0.3 * (3 * angle).sin(), RADIUS * angle.cos()), -1)
    poses_wc = torch.cat((centre, so3.exp(torch.stack((zero, angle, zero), -1))), -1)
    true = se3.inverse(poses_wc)
    size = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    xy = 8 + rand(frames * per_frame, 2) * (size - 16)
    depth = 3 + 12 * rand(frames * per_frame, 1)
    patches = torch.cat((xy, 1 / depth), -1)[..., None, None]
    intrinsics = torch.tensor([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], dtype=torch.float64).expand(frames, 4)

    near = torch.arange(-reach, reach + 1)
    around = torch.arange(-loop_reach, loop_reach + 1)
    offsets = torch.cat((near[near != 0], around + lap, around - lap))
    kk = torch.arange(frames * per_frame).repeat_interleave(len(offsets))
    ii = torch.div(kk, per_frame, rounding_mode="floor")
    jj = ii + offsets.repeat(frames * per_frame)
    inside = (jj >= 0) & (jj < frames)
    ii, jj, kk = ii[inside], jj[inside], kk[inside]
    kept, targets = [], []
    for part in torch.arange(len(ii)).split(1 << 16):
        seen = reproject(true[None], patches[None], intrinsics[None], ii[part], jj[part], kk[part])
        coords = seen.coords[0, :, 0, 0]
        good = seen.valid[0, :, 0, 0] & (coords > 0).all(-1) & (coords < size).all(-1)
        kept.append(part[good])
        targets.append(coords[good])
    which, target = torch.cat(kept), torch.cat(targets)
    target = target + noise * randn(*target.shape)
    outlier = rand(len(target)) < wrong
    target[outlier] = rand(int(outlier.sum()), 2) * size

    # Drift: each motion to the next frame has a small error.
    motions = se3.relative(true[:-1], true[1:])
    motions = se3.retract(motions, randn(frames - 1, 6) * torch.tensor([2e-3] * 3 + [4e-4] * 3, dtype=torch.float64))
    start = [true[0]]
    for motion in motions:
        start.append(se3.compose(motion, start[-1]))
    rough = patches.clone()
    rough[:, 2] *= 1 + 0.2 * (2 * rand(len(rough), 1, 1) - 1)
    weights = 0.5 + 0.5 * rand(len(target), 2)
    floats = (se3.normalise(torch.stack(start)), rough, intrinsics, target, weights)
    poses_cw, rough, intrinsics, target, weights = (x.to(dtype) for x in floats)
    edges = ii[which], jj[which], kk[which]
    return PatchProblem(poses_cw, rough, intrinsics, target, weights, *edges), true.to(dtype)


def position_error(poses_cw: Tensor, true_poses_cw: Tensor) -> float:
    """Root mean square distance of camera centres at the best common scale, with the first pose shared.

    Args:
        poses_cw, true_poses_cw: ``(N, 7)`` world to camera.

    Returns:
        Distance, in the unit of the true poses.
    """
    a, b = (se3.inverse(x)[:, :3] for x in (poses_cw, true_poses_cw))
    a, b = a - a[0], b - b[0]
    scale = (a * b).sum() / (a * a).sum()
    return float((scale * a - b).square().sum(-1).mean().sqrt())


def main() -> None:
    """Run the benchmark and print its results."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--patches", type=int, default=48, help="per frame")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--solver", default="auto", choices=("auto", "direct", "cg"))
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("--iterations", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    dtype = torch.float32 if arguments.float32 else torch.float64
    problem, true_poses_cw = make_graph(arguments.frames, arguments.patches, dtype=dtype)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    options = GlobalBAOptions(
        kernel=Kernel("huber", 1.0),
        solver=LMOptions(max_iterations=arguments.iterations, tolerance=1e-4, solver=arguments.solver),
    )
    wall, processor = time.perf_counter(), time.process_time()
    result = solve(problem, options)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    error = [position_error(x, true_poses_cw) for x in (problem.poses_cw, result.poses_cw)]
    print(f"frames {arguments.frames}, patches {len(problem.patches)}, edges {len(problem.ii)}")
    print(f"stored blocks {result.stored_blocks} ({result.stored_blocks / len(problem.ii):.2f} an edge)")
    print(f"{wall:.1f} s wall, {processor:.1f} s of processor, {arguments.threads} threads")
    print(f"{result.iterations} iterations, converged: {result.converged}")
    print(f"peak memory of the process {peak / 1024:.0f} MB, {before / 1024:.0f} MB before the call")
    print(f"cost {result.initial_cost:.4g} -> {result.cost:.6g}")
    print(f"position error {error[0]:.4f} -> {error[1]:.4f} (radius of the circle {RADIUS:g})")


if __name__ == "__main__":
    main()
