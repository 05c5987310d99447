"""Single measurements for :mod:`eval.benchmarks.compare_commits`: ``python measurements.py tracking CLIP``.

Run as a file, with the tree to be measured on PYTHONPATH. The file uses only names that exist in every version of dvo,
so that it can measure all of them. A line is printed for each part: ``SECONDS part processor wall``. The first are
processor time of this process, which other load of the machine hardly changes; with several threads they count the work
of all.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from importlib import import_module
from itertools import islice
from typing import Any

import cv2
import torch

import dvo

Seconds = tuple[float, float]
"""Processor time of this process, and time on the wall."""


def now() -> Seconds:
    """Both clocks."""
    return time.process_time(), time.perf_counter()


def since(start: Seconds) -> Seconds:
    """Seconds of both clocks since a reading of :func:`now`."""
    processor, wall = now()
    return processor - start[0], wall - start[1]


def tracking(clip: str, frames: int | None, preset: str | None = None) -> dict[str, Seconds]:
    """Track and finish a clip with the weights ``small``.

    Args:
        clip: folder of the clip.
        frames: number of its frames; None for all.
        preset: of the tracker; None for a version without presets.

    Returns:
        Seconds of ``track`` of all frames, and of ``finish``; without reading.
    """
    images = list(islice(dvo.open(clip), frames))
    odometry = dvo.load("small", seed=0, **({"preset": preset} if preset else {}))
    start = now()
    for frame in images:
        odometry.track(frame)
    found = {"track": since(start)}
    start = now()
    odometry.finish()
    return {**found, "finish": since(start)}


def bundle_adjustment(repeats: int, batch: int = 1, frames: int = 8, per_frame: int = 24) -> Seconds:
    """One bundle adjustment with its backward pass, on a problem as in training.

    Every patch has an edge into every other frame.

    Args:
        repeats: number of runs.
        batch, frames, per_frame: clips, frames of each and patches of a frame.

    Returns:
        Seconds of the fastest run.
    """
    generator = torch.Generator().manual_seed(0)
    count = frames * per_frame
    centres = torch.rand(batch, count, 2, generator=generator) * torch.tensor([40.0, 30.0])
    depth = 0.3 + torch.rand(batch, count, 1, generator=generator)
    patches = torch.cat((centres, depth), -1)[..., None, None].repeat(1, 1, 1, 3, 3)
    quaternion = torch.tensor([0.0, 0, 0, 1]).expand(batch, frames, 4)
    shifts = 0.05 * torch.randn(batch, frames, 3, generator=generator)
    poses = torch.cat((shifts, quaternion), -1)
    intrinsics = torch.tensor([35.0, 35, 20, 15]).repeat(batch, frames, 1)
    kk = torch.arange(count).repeat_interleave(frames)
    ii, jj = kk // per_frame, torch.arange(frames).repeat(count)
    ii, jj, kk = (x[ii != jj] for x in (ii, jj, kk))
    targets = centres[:, kk] + torch.randn(batch, len(kk), 2, generator=generator)
    weights = torch.rand(targets.shape, generator=generator)
    plan = edge_plan(ii, jj, kk, frames, count)
    best = float("inf"), float("inf")
    adjust: Any = dvo.bundle_adjust  # it returned a pair before it returned a BAResult
    for _ in range(repeats):
        leaves = [x.clone().requires_grad_() for x in (poses, patches, intrinsics, targets, weights)]
        start = now()
        found = adjust(*leaves, ii, jj, kk, plan=plan)
        moved, refined = (found.poses_cw, found.patches) if hasattr(found, "poses_cw") else found
        (moved.sum() + refined.sum()).backward()
        best = min(best, since(start))
    return best


def training() -> Callable[[], Seconds]:
    """A training step of ``small``: forward pass of a rendered clip, pose and flow loss, backward pass.

    Returns:
        Function that takes one step, the same every time, and returns its seconds.
    """
    from dvo.geometry import se3
    from dvo.losses.pose import pose_errors
    from dvo.synth.clip import make_clip

    try:
        from dvo.models.schedule import training_schedule
    except ImportError:  # before networks had a room of their own
        training_schedule = import_module("dvo.nets.schedule").training_schedule

    clip = make_clip(0, 1, frames=8, height=120, width=160, flow_range=(1.0, 14.0))
    model: Any = dvo.load_model("small").train()
    stages = training_schedule(8, model.config.training_patches, 10, 4, 4, model.config.self_edges)

    def step() -> Seconds:
        start = now()
        states = model.unroll(
            clip.images[None], clip.intrinsics[None], stages, poses_cw=se3.identity(1, 8),
            generator=torch.Generator().manual_seed(0), correlation_gradient=0.3,
        )  # fmt: skip
        loss = torch.zeros(())
        for state in states:
            errors = pose_errors(state.poses_cw, clip.poses_cw[None, : state.frames])
            loss = loss + (errors.translation + errors.rotation).mean() + 0.1 * (state.targets - 20).abs().mean()
        loss.backward()
        model.zero_grad()
        return since(start)

    return step


def edge_plan(ii: torch.Tensor, jj: torch.Tensor, kk: torch.Tensor, frames: int, count: int) -> Any:
    """Plan of the edges, as training makes it once for a fixed graph.

    Args:
        ii, jj, kk: ``(E,)`` source frame, target frame and patch.
        frames, count: numbers of frames and patches.

    Returns:
        The plan; None in a version without this function.
    """
    try:
        from dvo.ba.edges import plan_edges

        return plan_edges(ii, jj, kk, frames, count)
    except (ImportError, TypeError):
        return None


def main() -> None:
    """Run one measurement and print its seconds."""
    line = argparse.ArgumentParser(description=__doc__)
    line.add_argument("what", choices=("tracking", "ba", "training"))
    line.add_argument("clip", nargs="?")
    line.add_argument("--frames", type=int)
    line.add_argument("--preset")
    line.add_argument("--repeats", type=int, default=30)
    line.add_argument("--threads", type=int, default=1)
    given = line.parse_args()
    torch.set_num_threads(given.threads)
    cv2.setNumThreads(given.threads)
    try:
        from dvo.core.allocator import reuse_freed_memory  # as `dvo run` and training do

        reuse_freed_memory()
    except ImportError:
        pass
    if given.what == "training":
        step = training()
        print("READY", flush=True)
        for _ in sys.stdin:  # one step for every line, so that two processes can take turns
            report("training", step())
    elif given.what == "ba":
        report("ba", bundle_adjustment(given.repeats))
    else:
        for part, seconds in tracking(given.clip, given.frames, given.preset).items():
            report(part, seconds)


def report(part: str, seconds: Seconds) -> None:
    """Print the line of a part."""
    print(f"SECONDS {part} {seconds[0]:.9f} {seconds[1]:.9f}", flush=True)


if __name__ == "__main__":
    main()
