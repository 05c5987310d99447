"""Benchmark of the BA layer: ``python -m eval.benchmarks.ba_layer [--batch 1 4] [--device cpu]``.

Prints milliseconds of processor time (CPU) or wall time for two iterations, forward alone and with backward, the
fastest of several runs, and the ratio to the dense reference implementation in :mod:`dvo.ba.layer.reference`.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from dvo.ba.edges import plan_edges
from dvo.ba.layer.layer import bundle_adjust
from dvo.ba.layer.reference import bundle_adjust_reference
from dvo.core.command_line import OneLineParser
from dvo.geometry import se3
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


if __name__ == "__main__":
    main()
