"""Benchmark of pose graph optimisation: ``python -m eval.benchmarks.pose_graph [FILE...] [--poses 10000]``.

Prints for each g2o file, and for a synthetic graph of laps of a circle in Sim(3) with drifting scale: poses, edges,
chi2 of the poses given (as defined by g2o), which start was chosen and its chi2, chi2 after, steps, seconds (median
of ``--repeat``) and CPU seconds. With ``--chart log`` the error of a file is the logarithm, as GTSAM has it: chi2 is
then twice the error that GTSAM tells. ``--gtsam`` prints that too, of GTSAM's own Levenberg-Marquardt with its default
settings and the same tolerance (``pip install gtsam``), its seconds, and the ratio of ours to those; runs of the two
take turns.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from dvo.ba.pose_graph import Chart, PoseGraphOptions, optimise_pose_graph
from dvo.ba.sparse.block_matrix import LinearSolver
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3, so3

HELD = 1.0
"""Information of the three coordinates that a planar graph does not measure."""


@dataclass(frozen=True)
class PoseGraph:
    """Arguments of :func:`dvo.ba.pose_graph.optimise_pose_graph`, float64.

    Attributes:
        poses_cw: ``(N, 7)`` world to camera, in the order of the file.
        ii, jj: ``(E,)`` indices of the poses of each edge.
        measurements: ``(E, 7)`` measured ``T_j T_i^-1``.
        information: ``(E, 6, 6)`` in the coordinates of ``chart``.
        chart: "quaternion" for a 3-D graph, "split" for a planar one.
    """

    poses_cw: Tensor
    ii: Tensor
    jj: Tensor
    measurements: Tensor
    information: Tensor
    chart: Chart


def read_g2o(path: Path | str) -> PoseGraph:
    """Read ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT``, or ``VERTEX_SE2`` and ``EDGE_SE2`` embedded in SE(3).

    Args:
        path: text file; lines of other kinds are ignored.

    Returns:
        The graph.

    Raises:
        DvoError: no such file, no edges, invalid numbers, 2-D mixed with 3-D, or an edge to a missing vertex.
    """
    path = Path(path)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give a pose graph in g2o format")
    rows: dict[str, list[list[str]]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        word, *numbers = line.split() or [""]
        if word in ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "VERTEX_SE2", "EDGE_SE2"):
            rows.setdefault(word, []).append(numbers)
    planar = "EDGE_SE2" in rows
    if planar == ("EDGE_SE3:QUAT" in rows):
        raise DvoError("no edges, or both 2-D and 3-D edges", file=path, remedy="give a graph with one kind of edges")
    kind, size, upper = ("SE2", 3, 3) if planar else ("SE3:QUAT", 7, 6)
    try:
        vertices = np.array(rows.get(f"VERTEX_{kind}", []), dtype=np.float64).reshape(-1, 1 + size)
        edges = np.array(rows[f"EDGE_{kind}"], dtype=np.float64).reshape(-1, 2 + size + upper * (upper + 1) // 2)
    except ValueError as error:
        raise DvoError(
            "lines of unequal length, or words that are not numbers",
            file=path,
            remedy="check that the file is complete",
        ) from error
    names, order = np.unique(vertices[:, 0].astype(np.int64), return_index=True)
    ends = edges[:, :2].astype(np.int64)
    at = np.searchsorted(names, ends).clip(max=max(len(names) - 1, 0))
    if not len(names) or (names[at] != ends).any():
        raise DvoError("an edge to a missing vertex", file=path, remedy="check that the file is complete")
    index = torch.from_numpy(order[at])
    poses, relative = (_poses(x, planar) for x in (vertices[:, 1:], edges[:, 2 : 2 + size]))
    row, column = np.triu_indices(upper)
    matrix = np.zeros((len(edges), upper, upper))
    matrix[:, row, column] = matrix[:, column, row] = edges[:, 2 + size :]
    information = torch.from_numpy(matrix)
    if planar:
        place = torch.tensor([0, 1, 5])
        full = torch.diag_embed(torch.full((len(edges), 6), HELD, dtype=torch.float64))
        full[:, place[:, None], place] = information
        information = full
    inverse = se3.inverse(poses), se3.inverse(relative)
    chart: Chart = "split" if planar else "quaternion"
    return PoseGraph(inverse[0], index[:, 0], index[:, 1], inverse[1], information, chart)


def _poses(numbers: np.ndarray, planar: bool) -> Tensor:
    """``x y theta`` or ``x y z qx qy qz qw`` to poses ``(N, 7)``."""
    x = torch.from_numpy(np.ascontiguousarray(numbers))
    if not planar:
        return se3.normalise(x)
    zero = torch.zeros_like(x[:, :1])
    return torch.cat((x[:, :2], zero, so3.exp(torch.cat((zero, zero, x[:, 2:]), -1))), -1)


Graph = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Poses, ``ii``, ``jj``, measurements and information, see :func:`dvo.ba.pose_graph.optimise_pose_graph`."""


def make_laps(count: int, lap: int = 500, every: int = 5, seed: int = 0) -> Graph:
    """Synthetic pose graph in Sim(3): noisy motions along laps of a circle, and loop edges to the lap before.

    Args:
        count: number of poses.
        lap: number of poses of a lap.
        every: distance, in poses, of the loop edges.
        seed: of the noise.

    Returns:
        ``poses (N, 8)`` by chaining the motions, ``ii``, ``jj``, ``measurements (E, 8)`` and ``information (E, 7)``.
    """
    generator = torch.Generator().manual_seed(seed)
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / lap)
    zero = torch.zeros_like(angle)
    centre = torch.stack((10 * angle.sin(), 0.001 * torch.arange(count), 10 * angle.cos()), -1)
    true = sim3.from_se3(se3.inverse(torch.cat((centre, so3.exp(torch.stack((zero, angle, zero), -1))), -1)))
    loops = torch.arange(min(lap, count), count, every)
    ii = torch.cat((torch.arange(count - 1), loops - lap))
    jj = torch.cat((torch.arange(1, count), loops))
    sigma = torch.tensor([2e-3] * 3 + [1e-3] * 3 + [2e-3], dtype=torch.float64)
    noise = sim3.exp(sigma * torch.randn(len(ii), 7, dtype=torch.float64, generator=generator))
    measured = sim3.normalise(sim3.compose(noise, sim3.compose(true[jj], sim3.inverse(true[ii]))))
    poses = [true[0]]
    for motion in measured[: count - 1]:
        poses.append(sim3.compose(motion, poses[-1]))
    return sim3.normalise(torch.stack(poses)), ii, jj, measured, (sigma**-2).expand(len(ii), 7)


def gtsam_minimum(file: Path) -> tuple[float, float]:
    """Twice the error of GTSAM's Levenberg-Marquardt on a g2o file, the first pose held, and the seconds it took.

    Args:
        file: 2-D or 3-D pose graph.

    Raises:
        DvoError: GTSAM is not installed.
    """
    try:
        import gtsam
    except ImportError as error:
        raise DvoError("GTSAM is not installed", field="--gtsam", remedy="pip install gtsam") from error
    spatial = "EDGE_SE3" in file.read_text(encoding="utf-8")
    graph, start = gtsam.readG2o(str(file), spatial)
    first = min(start.keys())
    if spatial:
        graph.add(gtsam.NonlinearEqualityPose3(first, start.atPose3(first)))
    else:
        graph.add(gtsam.NonlinearEqualityPose2(first, start.atPose2(first)))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(LMOptions().tolerance)
    began = time.perf_counter()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, settings)
    optimiser.optimize()
    return 2 * float(optimiser.error()), time.perf_counter() - began


def main() -> None:
    """Run the benchmark and print a row for each graph."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--poses", type=int, default=0, help="of the generated graph")
    parser.add_argument("--chart", default="g2o", choices=("g2o", "log"), help="coordinates of the error of the files")
    parser.add_argument("--gtsam", action="store_true", help="minimise each file with GTSAM as well")
    parser.add_argument("--solver", default="auto", choices=get_args(LinearSolver))
    parser.add_argument("--start", default="best", choices=("best", "given"))
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--repeat", type=int, default=3, help="runs of each, of which the median is printed")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    solver = replace(PoseGraphOptions().solver, max_iterations=arguments.iterations, solver=arguments.solver)
    repeat = max(arguments.repeat, 1)
    print(
        f"{'graph':24} {'poses':>6} {'edges':>6} {'chi2 given':>18} {'start':>10} {'chi2 of it':>18} {'after':>15}"
        f" {'steps':>5} {'s':>7} {'cpu s':>7}" + (f" {'GTSAM':>15} {'s':>7} {'ratio':>6}" if arguments.gtsam else "")
    )

    def row(name: str, chart: Chart, graph: Graph, file: Path | None = None) -> None:
        seconds, cpu, peers = [], [], []
        for _ in range(repeat):
            options = PoseGraphOptions(chart=chart, solver=solver, start=arguments.start)
            began = time.perf_counter(), time.process_time()
            result = optimise_pose_graph(*graph, options=options)
            seconds.append(time.perf_counter() - began[0])
            cpu.append(time.process_time() - began[1])
            if file is not None:
                peers.append(gtsam_minimum(file))
        own = statistics.median(seconds)
        text = (
            f"{name:24} {len(graph[0]):6} {len(graph[1]):6} {result.initial_chi2:18.6f} {result.start:>10}"
            f" {result.start_chi2:18.6f} {result.chi2:15.6f} {result.iterations:5} {own:7.2f}"
            f" {statistics.median(cpu):7.2f}"
        )
        if peers:
            peer = statistics.median(s for _, s in peers)
            text += f" {peers[0][0]:15.6f} {peer:7.2f} {own / peer:6.2f}"
        print(text, flush=True)

    laps = make_laps(8, 4)
    optimise_pose_graph(*laps, options=PoseGraphOptions(solver=solver))  # imports, once
    for file in arguments.files:
        g = read_g2o(file)
        chart = "log" if arguments.chart == "log" else g.chart
        graph = (g.poses_cw, g.ii, g.jj, g.measurements, g.information)
        row(file.name, chart, graph, file if arguments.gtsam else None)
    if arguments.poses:
        row("laps in Sim(3)", "log", make_laps(arguments.poses))


if __name__ == "__main__":
    main()
