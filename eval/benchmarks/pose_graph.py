"""Benchmark of pose graph optimisation: ``python -m eval.benchmarks.pose_graph [FILE...] [--poses 10000]``.

Prints poses, edges, chi2 before and after (as defined by g2o), iterations and seconds for each g2o file, and for a
synthetic graph of laps of a circle in Sim(3) with drifting scale. With ``--chart log`` the error of a file is the
logarithm, as GTSAM has it: chi2 is then twice the error that GTSAM tells. ``--gtsam`` prints that
too, of GTSAM's own Levenberg-Marquardt (``pip install gtsam``).
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dvo.ba.pose_graph import Chart, PoseGraphOptions, optimise_pose_graph
from dvo.ba.sparse.levenberg import LMOptions
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


def make_laps(
    count: int, lap: int = 500, every: int = 5, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
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
    loops = torch.arange(lap, count, every)
    ii = torch.cat((torch.arange(count - 1), loops - lap))
    jj = torch.cat((torch.arange(1, count), loops))
    sigma = torch.tensor([2e-3] * 3 + [1e-3] * 3 + [2e-3], dtype=torch.float64)
    noise = sim3.exp(sigma * torch.randn(len(ii), 7, dtype=torch.float64, generator=generator))
    measured = sim3.normalise(sim3.compose(noise, sim3.compose(true[jj], sim3.inverse(true[ii]))))
    poses = [true[0]]
    for motion in measured[: count - 1]:
        poses.append(sim3.compose(motion, poses[-1]))
    return sim3.normalise(torch.stack(poses)), ii, jj, measured, (sigma**-2).expand(len(ii), 7)


def gtsam_chi2(file: Path) -> float:
    """Twice the error of GTSAM's Levenberg-Marquardt on a g2o file, the first pose held.

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
    held = gtsam.NonlinearEqualityPose3 if spatial else gtsam.NonlinearEqualityPose2
    graph.add(held(first, start.atPose3(first) if spatial else start.atPose2(first)))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-10)
    settings.setAbsoluteErrorTol(1e-10)
    settings.setMaxIterations(500)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, settings)
    optimiser.optimize()
    return 2 * float(optimiser.error())


def main() -> None:
    """Run the benchmark and print a row for each graph."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--poses", type=int, default=0, help="of the generated graph")
    parser.add_argument("--chart", default="g2o", choices=("g2o", "log"), help="coordinates of the error of the files")
    parser.add_argument("--gtsam", action="store_true", help="minimise each file with GTSAM as well")
    parser.add_argument("--solver", default="auto", choices=("auto", "direct", "cg"))
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    solver = LMOptions(max_iterations=arguments.iterations, damping=1e-6, solver=arguments.solver)
    print(
        f"{'graph':28} {'poses':>6} {'edges':>6} {'chi2 before':>14} {'after':>14} {'steps':>5} {'s':>6} {'cpu s':>6}"
    )

    def row(name: str, chart: Chart, *graph: Tensor) -> None:
        start, cpu = time.perf_counter(), time.process_time()
        result = optimise_pose_graph(*graph, options=PoseGraphOptions(chart=chart, solver=solver))
        start, cpu = time.perf_counter() - start, time.process_time() - cpu
        print(
            f"{name:28} {len(graph[0]):6} {len(graph[1]):6} {result.initial_chi2:14.6f} {result.chi2:14.6f}"
            f" {result.iterations:5} {start:6.1f} {cpu:6.1f}"
        )

    for file in arguments.files:
        g = read_g2o(file)
        chart = "log" if arguments.chart == "log" else g.chart
        row(file.name, chart, g.poses_cw, g.ii, g.jj, g.measurements, g.information)
        if arguments.gtsam:
            print(f"{'  GTSAM':28} {'':6} {'':6} {'':14} {gtsam_chi2(file):14.6f}")
    if arguments.poses:
        row("laps in Sim(3)", "log", *make_laps(arguments.poses))


if __name__ == "__main__":
    main()
