"""Keyframe graph of a made-up walk, as a tracker leaves it."""

import torch

from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.map.archive import ArchiveConfig
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.window import Keyframe
from dvo.nets.patch.patchifier import patch_coordinates

M, REACH = 8, 6  # patches of a frame; frames that an edge reaches
ROWS, INTERVAL = 60, 0.1  # height of the feature map; seconds between frames
INTRINSICS = torch.tensor([40.0, 40.0, 30.0, 30.0], dtype=torch.float64)


def pose_at(times: torch.Tensor) -> torch.Tensor:
    """World to camera at ``(...)`` seconds: along a wall with a swaying hand."""
    zero = torch.zeros_like(times)
    sway = [0.05 * torch.sin(2.1 * times + phase) for phase in (0.0, 1.0, 2.0)]
    return se3.exp(torch.stack([-1.0 * times, 0.1 * torch.sin(3 * times), zero, *sway], -1))


def project(points: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
    """Pixels of world points for a camera at a time each."""
    seen = se3.act(pose_at(times), points)
    return seen[:, :2] / seen[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]


def archived_walk(
    frames: int = 40,
    wrong: float = 0.0,
    dropped: tuple[int, ...] = (),
    archive: ArchiveConfig | None = None,
    readout: float = 0.0,
    interval: float = INTERVAL,
    archived: bool = True,
    unit: float = 0.0,
) -> tuple[KeyframeGraph, Trajectory]:
    """Graph of a walk with poses that drift in scale; and the true trajectory.

    Args:
        frames: number of keyframes.
        wrong: share of measurements that are off by some pixels.
        dropped: frames that are dropped.
        archive: bound of its memory.
        readout: of the rolling shutter that the measurements were made with, seconds.
        interval: between frames, seconds.
        archived: all frames have left the window.
        unit: metres of the unit of the walk, with depths measured by a depth camera; 0 for none.
    """
    g = torch.Generator().manual_seed(0)
    times = interval * torch.arange(frames, dtype=torch.float64)
    true = pose_at(times)
    centres = torch.randint(6, 54, (1, frames, M, 2), generator=g)
    depth = 0.3 + 0.4 * torch.rand(1, frames * M, generator=g)
    patches = patch_coordinates(centres, depth, 3)
    graph = KeyframeGraph(M, 3, 4, torch.device("cpu"), archive)
    drift = torch.linspace(1.0, 1.5, frames).double()
    for i in range(frames):
        part = slice(i * M, (i + 1) * M)
        frame = Keyframe(i, float(times[i]), i, torch.zeros(M, 8, 3, 3), torch.zeros(M, 4), torch.zeros(M, 3),
                         INTRINSICS.float())  # fmt: skip
        if unit:
            frame.measured = torch.stack([depth[0, part] / unit, torch.full((M,), 100.0)], 1)
        graph.window.append(frame, torch.cat([true[i, :3] * drift[i], true[i, 3:]]).float(), patches[0, part])
        graph.log.add(float(times[i]), i)
    kk = torch.arange(frames * M).repeat_interleave(frames)
    jj = torch.arange(frames).repeat(frames * M)
    near = (kk // M != jj) & ((kk // M - jj).abs() <= REACH)
    kk, jj = kk[near], jj[near]
    graph.window.connect(kk, jj)

    def row_time(v: torch.Tensor) -> torch.Tensor:
        return (4 * v - (4 * ROWS - 1) / 2) * readout / (4 * ROWS)

    xy = centres.reshape(-1, 2).double()
    rays = torch.cat([(xy - INTRINSICS[2:]) / INTRINSICS[:2], torch.ones(len(xy), 1)], 1) / depth[0, :, None].double()
    source = torch.arange(frames).repeat_interleave(M)
    points = se3.act(se3.inverse(pose_at(times[source] + row_time(xy[:, 1]))), rays)[kk]
    seen = project(points, times[jj])
    for _ in range(30):  # the row that a point is seen in decides on its time
        seen = project(points, times[jj] + row_time(seen[:, 1]))
    bad = torch.rand(len(kk), generator=g) < wrong
    graph.window.targets = (seen + bad[:, None] * torch.tensor([3.0, 1.0])).float()
    graph.window.weights = torch.full((len(kk), 2), 0.5)
    for i in sorted(dropped, reverse=True):
        graph.drop(i)
    while archived and len(graph.window):
        graph.archive_oldest()
    return graph, Trajectory(times.numpy(), se3.inverse(true).numpy())
