"""Speed by stage and peak memory of the tracker on 320x240 video.

``python -m eval.benchmarks.tracking_speed [--weights small] [--threads 2] [--frames 150]``
"""

from __future__ import annotations

import cProfile
import math
import pstats
import resource
import time

import torch

from dvo.core.allocator import reuse_freed_memory
from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.threads import settle_threads
from dvo.odometry.load import load
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.synth.sequence import make_sequence

STAGES = {
    "alignment without the network": ("frame_alignment.py", "align"),
    "pixels fixed to the image": ("fixed_pixels.py", "see"),
    "encoder and patches": ("front_end.py", "observe"),
    "graph index": ("edges.py", "build_graph"),
    "reprojection": ("projection.py", "reproject"),
    "correlation": ("edge_correlation.py", "lookup"),
    "update operator": ("update.py", "forward"),
    "bundle adjustment": ("layer.py", "dense_solution"),
    "keyframes": ("tracker.py", "_reduce"),
}


def _cumulative(stats: pstats.Stats, file: str, function: str) -> float:
    rows = [row for (path, _, name), row in stats.stats.items() if path.endswith(file) and name == function]  # type: ignore[attr-defined]
    return max((row[3] for row in rows), default=math.nan)  # nan: the function was not called


def main() -> None:
    """Run the benchmark and print its results."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--weights", default="small")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--warmup", type=int, default=30, help="frames before timing starts")
    options = parser.parse_args()
    reuse_freed_memory()
    settle_threads()  # later calls, such as that of load, keep the number set here
    torch.set_num_threads(options.threads)
    frames = list(make_sequence(1, frames=options.frames, height=240, width=320))

    def ready() -> PatchOdometry:
        odometry = load(options.weights)
        if not isinstance(odometry, PatchOdometry):
            remedy = "give weights of a patch network"
            raise DvoError("has no such stages", file=options.weights, field="--weights", remedy=remedy)
        for frame in frames[: options.warmup]:
            odometry.track(frame)
        return odometry

    odometry = ready()
    times = []
    for frame in frames[options.warmup :]:
        start = time.perf_counter()
        odometry.track(frame)
        times.append(time.perf_counter() - start)
    times.sort()
    mean = sum(times) / len(times)
    print(f"{1 / mean:.1f} frames/s on {options.threads} threads; {1e3 * mean:.1f} ms a frame, "
          f"p95 {1e3 * times[int(0.95 * len(times))]:.1f} ms; edges {len(odometry.window.kk)}; "
          f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")  # fmt: skip

    odometry = ready()
    profile = cProfile.Profile()
    profile.enable()
    for frame in frames[options.warmup :]:
        odometry.track(frame)
    profile.disable()
    stats = pstats.Stats(profile)
    whole = _cumulative(stats, "tracker.py", "track")
    print("share of the time of a frame, under the profiler:")
    for stage, (file, function) in STAGES.items():
        print(f"  {stage:30s} {100 * _cumulative(stats, file, function) / whole:5.1f} %")


if __name__ == "__main__":
    main()
