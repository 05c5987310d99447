"""Pose graphs from g2o files: ``python -m eval.benchmarks.pose_graph FILE...``.

Prints for each file poses, edges, chi2 before and after (as g2o defines it), iterations and seconds.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dvo.ba.levenberg import LMOptions
from dvo.ba.pose_graph import Chart, PoseGraphOptions, optimise_pose_graph
from dvo.errors import DvoError
from dvo.geometry import se3, so3

HELD = 1.0
"""Information of the three coordinates that a planar graph does not measure."""


@dataclass(frozen=True)
class PoseGraph:
    """Arguments of :func:`dvo.ba.pose_graph.optimise_pose_graph`, float64.

    Attributes:
        poses_cw: ``(N, 7)``, in the order of the file.
        ii, jj: ``(E,)``.
        measurements: ``(E, 7)`` of ``T_j T_i^-1``.
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
        path: text file. Lines of other kinds are passed over.

    Raises:
        DvoError: no such file, no edges, wrong numbers, 2-D mixed with 3-D, or an edge to a vertex that is not there.
    """
    path = Path(path)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give a pose graph in g2o format")
    rows: dict[str, list[list[float]]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        word, *numbers = line.split() or [""]
        if word in ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "VERTEX_SE2", "EDGE_SE2"):
            rows.setdefault(word, []).append([float(x) for x in numbers])
    planar = "EDGE_SE2" in rows
    if planar == ("EDGE_SE3:QUAT" in rows):
        raise DvoError("no edges, or edges of 2-D and 3-D", file=path, remedy="give a graph with one kind of edges")
    kind, size, upper = ("SE2", 3, 3) if planar else ("SE3:QUAT", 7, 6)
    try:
        vertices = np.array(rows.get(f"VERTEX_{kind}", []), dtype=np.float64).reshape(-1, 1 + size)
        edges = np.array(rows[f"EDGE_{kind}"], dtype=np.float64).reshape(-1, 2 + size + upper * (upper + 1) // 2)
    except ValueError as error:
        raise DvoError("lines of unequal length", file=path, remedy="check that the file is complete") from error
    names, order = np.unique(vertices[:, 0].astype(np.int64), return_index=True)
    ends = edges[:, :2].astype(np.int64)
    at = np.searchsorted(names, ends).clip(max=max(len(names) - 1, 0))
    if not len(names) or (names[at] != ends).any():
        raise DvoError("an edge of a vertex that is not there", file=path, remedy="check that the file is complete")
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


def main() -> None:
    """Print a row for each file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--solver", default="auto", choices=("auto", "direct", "cg"))
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(f"{'file':28} {'poses':>6} {'edges':>6} {'chi2 before':>14} {'after':>14} {'steps':>5} {'s':>6} {'cpu s':>6}")
    for file in arguments.files:
        graph = read_g2o(file)
        solver = LMOptions(max_iterations=arguments.iterations, damping=1e-6, solver=arguments.solver)
        options = PoseGraphOptions(chart=graph.chart, solver=solver)
        start, cpu = time.perf_counter(), time.process_time()
        result = optimise_pose_graph(graph.poses_cw, graph.ii, graph.jj, graph.measurements, graph.information, options)
        start, cpu = time.perf_counter() - start, time.process_time() - cpu
        print(
            f"{file.name:28} {len(graph.poses_cw):6} {len(graph.ii):6} {result.initial_chi2:14.6f} {result.chi2:14.6f}"
            f" {result.iterations:5} {start:6.1f} {cpu:6.1f}"
        )


if __name__ == "__main__":
    main()
