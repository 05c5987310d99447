"""A walk there and back, and settings with which a tracker on it closes loops soon."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import dvo
from dvo.data.trajectory import Trajectory
from dvo.odometry.loops.options import LoopOptions
from dvo.synth.sequence import make_sequence

THERE = 28
SHORT = {"keyframe_motion": 0.5, "removal": 5, "lifetime": 4, "optimisation": 5}  # keyframes leave the window soon
OPTIONS = LoopOptions(seconds=1.0, every=2, neighbours=1, steps=4, delay=4)


@cache
def there_and_back(there=THERE):
    """Frames of a walk and the same in reverse, with times that go on; and the true trajectory."""
    walk = make_sequence(
        63, frames=there, family="room", kind="handheld", speed=5.0, height=120, width=160, fps=15.0, sensor=False
    )
    order = [*range(there), *range(there - 2, -1, -1)]
    clip, times = list(walk), np.arange(len(order)) / 15.0
    frames = [replace(clip[k], timestamp=float(t)) for k, t in zip(order, times, strict=True)]
    return frames, Trajectory(times, walk.groundtruth.poses_wc[order])


def track(frames, options=OPTIONS, **settings):
    odometry = dvo.load("small", device="cpu", loop=options, **SHORT, **settings)
    estimates = [odometry.track(frame) for frame in frames]
    return odometry, estimates, odometry.finish()


def until(film, state, **settings):
    """Tracker of the walk as soon as its loop closure is in a state, and the frames tracked by then."""
    odometry = dvo.load("small", device="cpu", loop=OPTIONS, **SHORT, **settings)
    for count, frame in enumerate(film[0], 1):
        odometry.track(frame)
        if state(odometry.loops):
            return odometry, count
    raise AssertionError
