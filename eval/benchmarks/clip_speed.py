"""Speed of tracking on one clip, for :mod:`eval.benchmarks.threads`: ``python clip_speed.py CLIP``.

Run as a file, so that torch is not imported before the environment and ``--before`` have decided on the threads. Prints
``SPEED frames/s threads policy``.
"""

from __future__ import annotations

import argparse
import time
from itertools import islice
from typing import Any


def main() -> None:
    """Track the clip and print the speed."""
    line = argparse.ArgumentParser(description=__doc__)
    line.add_argument("clip", metavar="CLIP", help="what dvo.open takes")
    line.add_argument("--weights", default="small")
    line.add_argument("--frames", type=int, default=60, help="frames, those before timing included")
    line.add_argument("--warmup", type=int, default=12, help="frames before timing starts")
    line.add_argument("--seconds", type=float, default=60.0, help="longest time, of warm-up and measurement each")
    line.add_argument("--before", action="store_true", help="threads as if dvo chose nothing")
    given = line.parse_args()
    if given.before:
        import cv2
        import torch

        counts = torch.get_num_threads(), cv2.getNumThreads()
    import dvo
    from dvo.core.threads import current_threads

    frames = list(islice(dvo.open(given.clip), given.frames))
    odometry = dvo.load(given.weights)
    if given.before:
        torch.set_num_threads(counts[0])
        cv2.setNumThreads(counts[1])
    track(odometry, frames[: given.warmup], given.seconds)
    speed = track(odometry, frames[given.warmup :], given.seconds)
    threads = current_threads()
    print(f"SPEED {speed:.4f} {threads.count} {threads.wait_policy}")


def track(odometry: Any, frames: list[Any], seconds: float) -> float:
    """Track frames until the time is over, and at least one.

    Args:
        odometry: on the clip.
        frames: to track.
        seconds: time after which no further frame is tracked.

    Returns:
        Frames per second.
    """
    start, count = time.perf_counter(), 0
    for frame in frames:
        odometry.track(frame)
        count += 1
        if time.perf_counter() - start > seconds:
            break
    return count / (time.perf_counter() - start)


if __name__ == "__main__":
    main()
