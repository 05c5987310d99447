"""Places that are found again: `python -m eval.benchmarks.relocalisation [maps|dark|jump] [--seeds 3]`.

`maps`: each sequence of the suites `revisit` and `revisit/test` is tracked to a third and saved; the map is loaded, and
frames are tracked in it: those that follow, and those of the second lap from 0.8 of the sequence on, which show the
first third again. The table has the number of frames until the camera was found (at most 3 wanted) and the error
of its pose then, in percent of the way in the map, under the similarity that aligns the map with the truth. Last, each
map meets frames of the other sequences, in which the camera must not be found.

`dark`: walks in rendered rooms of 160x120 that are dark for ten frames and then go back over the way they came, with a
window that keyframes leave soon and that no frame is joined with across the darkness: one room with the seeds 0 to 5 of
the tracker, and six others. The table has the first frame after the darkness that was found, the segments that share
a world, and the ATE of the poses that were told while tracking and of the result. Then six walks go on in another room.

`jump`: walks in rendered rooms of 320x240 with a gap of two seconds, in which the camera is moved aside and turned
(:data:`JUMPS`). The table has the segments that share a world, how the loops that joined them were found, and the ATE.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dvo
from dvo.core.command_line import OneLineParser
from dvo.data.files.output import scratch_folder
from dvo.data.frame import Frame
from dvo.data.source import Source
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.metrics import associate, evaluate, fit_alignment, transform
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.synth.protocols import Motion
from dvo.synth.sequence import film, make_sequence
from eval.suites.selection import load_suites
from eval.suites.suite import open_sequence, reference_for

FEW = 3
"""Frames within which the camera is wanted to be found."""
TRIED = 10
"""Frames that are tracked in a map."""
AGAIN = 0.8
"""Share of a sequence after which the second lap shows the first third."""


@dataclass(frozen=True)
class Recorded:
    """Sequence with its truth.

    Attributes:
        name: of the sequence.
        source: its frames.
        truth: a row for each frame.
    """

    name: str
    source: Source
    truth: Trajectory

    def frames(self, start: float, count: int) -> list[Frame]:
        """Frames from a share of the sequence on."""
        first = int(start * len(self.truth))
        return list(islice(self.source, first, first + count))


def saved(recorded: Recorded, seed: int, file: Path) -> Trajectory:
    """Track the first third and save it; the trajectory that the map holds."""
    odometry = dvo.load("small", seed=seed)
    assert isinstance(odometry, PatchOdometry)
    for frame in islice(recorded.source, len(recorded.truth) // 3):
        odometry.track(frame)
    odometry.save(file)
    return dvo.load_map(file).finish().trajectory


def found_after(file: Path, frames: Iterable[Frame], seed: int) -> tuple[int | None, dvo.Estimate | None]:
    """Number of frames until the camera is found in a map, and the estimate that tells of it; None if it is not."""
    odometry = dvo.load_map(file, seed=seed)
    for count, frame in enumerate(frames, 1):
        estimate = odometry.track(frame)
        if estimate.recovered:
            return count, estimate
    return None, None


def error_percent(estimate: dvo.Estimate, known: Trajectory, truth: Trajectory) -> float:
    """Distance of a pose from the truth, in percent of the way in the map."""
    own, true = associate(known, truth)
    assert estimate.pose_wc is not None
    pose = Trajectory(np.array([estimate.timestamp]), estimate.pose_wc[None])
    aligned = transform(pose, *fit_alignment(known.positions[own], truth.positions[true], "sim3"))
    at = int(np.abs(truth.timestamps - estimate.timestamp).argmin())
    way = float(np.linalg.norm(np.diff(truth.positions[true], axis=0), axis=1).sum())
    return 100 * float(np.linalg.norm(aligned.positions[0] - truth.positions[at])) / way


ROOMS = (63, 101, 102, 103, 104, 105, 106)
LIT, DARK, FPS = 34, 10, 15.0
SHORT: dict[str, Any] = {"keyframe_motion": 0.5, "removal": 5, "lifetime": 4, "optimisation": 5, "join_inliers": 1.0}
JUMPS = ((102, (0.5, 0.0, 0.0), 15.0), (103, (0.5, 0.0, 0.2), 15.0), (101, (0.8, 0.0, 0.0), 20.0))
"""Room, translation in the camera (m) and turn to the right (degrees)."""
BEFORE, BEHIND, GAP = 32, 40, 2.0
LOOP = {"seconds": 1.0, "every": 2, "steps": 4, "delay": 4}


def interrupted(room: int, other: int | None = None) -> tuple[list[Frame], Trajectory]:
    """Frames of a room, darkness, and the way back there or another room; and the truth for the first case."""
    walks = [
        make_sequence(
            seed, frames=40, family="room", kind="handheld", speed=5.0, height=120, width=160, fps=FPS, sensor=False
        )
        for seed in (room, room if other is None else other)
    ]
    first, second = map(list, walks)
    after = [*range(20, -1, -1), *range(1, 20)] if other is None else [*range(40)]
    black = replace(first[0], image=np.zeros_like(first[0].image))
    views = [*first[:LIT], *[black] * DARK, *(second[k] for k in after)]
    times = np.arange(len(views)) / FPS
    frames = [replace(view, timestamp=float(time)) for view, time in zip(views, times, strict=True)]
    return frames, Trajectory(times, walks[0].groundtruth.poses_wc[[*range(LIT), *[LIT] * DARK, *after]])


def dark() -> None:
    """Table of the walks with darkness."""
    print("| room | seed | found after | worlds | ATE % told | ATE % result |\n|--:|--:|--:|--:|--:|--:|")
    for room, seed in [*((ROOMS[0], seed) for seed in range(6)), *((room, 0) for room in ROOMS[1:])]:
        frames, truth = interrupted(room)
        odometry = dvo.load("small", seed=seed, loop=LOOP, **SHORT)
        estimates = [odometry.track(frame) for frame in frames]
        result, back = odometry.finish(), [k for k, e in enumerate(estimates) if e.recovered]
        told = "-"
        if back:
            rows = [e for e in (*estimates[:LIT], *estimates[back[0] :]) if e.status is dvo.Status.TRACKING]
            poses = np.stack([e.pose_wc for e in rows if e.pose_wc is not None])
            told = f"{evaluate(Trajectory(np.array([e.timestamp for e in rows]), poses), truth).ate_percent:.2f}"
        worlds = len({k if one.joined_to is None else one.joined_to for k, one in enumerate(result.segments)})
        after = str(back[0] - LIT - DARK + 1) if back else "-"
        ate = evaluate(result.trajectory, truth).ate_percent
        print(f"| {room} | {seed} | {after} | {worlds} | {told} | {ate:.2f} |", flush=True)
    pairs = list(zip(ROOMS, [*ROOMS[1:], ROOMS[0]], strict=True))[:6]
    wrong = 0
    for room, other in pairs:
        odometry = dvo.load("small", loop=LOOP, **SHORT)
        found = [odometry.track(frame).recovered for frame in interrupted(room, other)[0]]
        wrong += any(found) or any(segment.joined_to is not None for segment in odometry.finish().segments)
    print(f"\nJoined with another room: {wrong} of {len(pairs)}")


@dataclass(frozen=True)
class Jump:
    """Motion of a camera that is moved once.

    Attributes:
        path: without the jump.
        time: of the first frame after it, seconds.
        change: ``(7,)`` pose of the moved camera in the one that it would have been.
    """

    path: Motion
    time: float
    change: np.ndarray

    def poses_wc(self, times: np.ndarray) -> np.ndarray:
        """Camera-to-world poses ``(N, 7)`` at times in seconds."""
        poses = torch.from_numpy(self.path.poses_wc(times))
        moved = se3.compose(poses, torch.from_numpy(self.change).expand(len(poses), 7))
        return np.where((np.asarray(times) >= self.time - 1e-6)[:, None], moved.numpy(), poses.numpy())


def jumped(room: int, move: tuple[float, float, float], turn: float) -> tuple[list[Frame], Trajectory]:
    """Frames of a room before and after a jump, and their truth."""
    count = BEFORE + BEHIND
    walk = make_sequence(
        room, frames=count, family="room", kind="handheld", speed=1.0, height=240, width=320, fps=FPS, sensor=False
    )
    yaw = np.deg2rad(turn) / 2
    path = Jump(walk.path, BEFORE / FPS, np.array([*move, 0.0, np.sin(yaw), 0.0, np.cos(yaw)]))
    made = film(walk.scene, path, walk.camera, seed=walk.seed, times=np.arange(count) / FPS)
    times = np.arange(count) / FPS + GAP * (np.arange(count) >= BEFORE)
    frames = [replace(frame, timestamp=float(time)) for frame, time in zip(made, times, strict=True)]
    return frames, Trajectory(times, made.groundtruth.poses_wc)


def jumps() -> None:
    """Table of the walks with a jump."""
    print("| room | jump m | turn ° | segments | worlds | joined by | ATE % |\n|--:|--:|--:|--:|--:|---|--:|")
    for room, move, turn in JUMPS:
        frames, truth = jumped(room, move, turn)
        odometry = dvo.load("small")
        for frame in frames:
            odometry.track(frame)
        result = odometry.finish()
        worlds = len({k if one.joined_to is None else one.joined_to for k, one in enumerate(result.segments)})
        kinds = [loop["kind"] for loop in result.info["loops"] if loop["joins_segments"]]
        far, ate = float(np.linalg.norm(move)), evaluate(result.trajectory, truth).ate_percent
        cells = [room, f"{far:.2f}", f"{turn:.0f}", len(result.segments), worlds, ", ".join(kinds) or "-", f"{ate:.2f}"]
        print(f"| {' | '.join(map(str, cells))} |", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", nargs="?", choices=("maps", "dark", "jump"), default="maps")
    parser.add_argument("--suites", type=lambda text: text.split(","), default=["revisit", "revisit/test"])
    parser.add_argument("--sequences", type=lambda text: text.split(","), help="names with commas between")
    parser.add_argument("--seeds", type=int, default=3, help="of the tracker, 0 to N-1 (3)")
    options = parser.parse_args(arguments)
    if options.mode != "maps":
        (dark if options.mode == "dark" else jumps)()
        return
    recorded = []
    for suite in load_suites(options.suites, options.sequences):
        for sequence in suite.sequences:
            source, truth = open_sequence(sequence, Path(), suite.stride)
            stamps = np.array([frame.timestamp for frame in source])
            recorded.append(Recorded(sequence.name, source, reference_for(truth, stamps)))
    within = {"goes on": 0, "comes back": 0}
    elsewhere = wrong = 0
    print("| sequence | seed | frames, goes on | error % | frames, comes back | error % |\n|---|--:|--:|--:|--:|--:|")
    with scratch_folder("dvo-relocalisation") as folder:
        for one in recorded:
            for seed in range(options.seeds):
                file = folder / f"{one.name}_{seed}.dvo"
                known, cells = saved(one, seed, file), []
                for kind, start in (("goes on", 1 / 3), ("comes back", AGAIN)):
                    count, estimate = found_after(file, one.frames(start, TRIED), seed)
                    within[kind] += count is not None and count <= FEW
                    error = "-" if estimate is None else f"{error_percent(estimate, known, one.truth):.2f}"
                    cells += ["-" if count is None else str(count), error]
                print(f"| {one.name} | {seed} | {' | '.join(cells)} |", flush=True)
            for other in recorded:
                if other is not one:
                    elsewhere += 1
                    wrong += found_after(folder / f"{one.name}_0.dvo", other.frames(0.2, TRIED), 0)[0] is not None
    runs = len(recorded) * options.seeds
    print(f"\nFound within {FEW} frames: " + ", ".join(f"{kind} {count} of {runs}" for kind, count in within.items()))
    print(f"Found in maps of other places: {wrong} of {elsewhere}")


if __name__ == "__main__":
    main()
