"""Pose graphs: Jacobians against autograd, g2o files, and drift of scale around a circle."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.ba.factors import RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.planar_edges import PLANE, in_plane, planar_edges
from dvo.ba.pose_graph import (
    LOOP_OPTIONS,
    Chart,
    PoseGraphOptions,
    optimise_pose_graph,
    residuals,
    residuals_and_jacobians,
    right_jacobian,
)
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3
from eval.benchmarks.pose_graph import PoseGraph, make_laps, read_g2o

GROUPS = {6: se3, 7: sim3}
CHARTS: tuple[Chart, ...] = ("log", "split", "quaternion")


def random_graph(dim: int, seed: int, angle: float = 0.6) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Poses, ii, jj and measurements that are far from fitting."""
    generator = torch.Generator().manual_seed(seed)
    group = GROUPS[dim]
    tangent = torch.randn(12, dim, dtype=torch.float64, generator=generator) * angle
    if dim == 7:
        tangent[:, 6] *= 0.3
    ii, jj = torch.tensor([0, 1, 2, 3, 4, 2]), torch.tensor([1, 2, 0, 1, 3, 4])
    return group.exp(tangent[:5]), ii, jj, group.exp(tangent[5:11])


@pytest.mark.long
@settings(max_examples=15)
@given(st.sampled_from([6, 7]), st.sampled_from(CHARTS), st.integers(0, 10_000))
def test_jacobians_are_those_of_autograd(dim: int, chart: Chart, seed: int):
    poses, ii, jj, measured = random_graph(dim, seed)
    group = GROUPS[dim]

    def moved(a: Tensor, b: Tensor) -> Tensor:
        ends = torch.cat((group.retract(poses[ii], a), group.retract(poses[jj], b)))
        edge = torch.arange(len(ii))
        return residuals(ends, edge, edge + len(ii), measured, chart)

    zero = torch.zeros(len(ii), dim, dtype=torch.float64)
    e, j_i, j_j = residuals_and_jacobians(poses, ii, jj, measured, chart)
    torch.testing.assert_close(e, moved(zero, zero))
    for found, expected in zip((j_i, j_j), torch.autograd.functional.jacobian(moved, (zero, zero)), strict=True):
        torch.testing.assert_close(found, expected.diagonal(dim1=0, dim2=2).permute(2, 0, 1), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("dim", [6, 7])
def test_the_right_jacobian_is_that_of_the_quadrature(dim: int):
    xi = torch.randn(200, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 5
    xi[:, 3:6] *= (torch.linspace(0, math.pi, 200, dtype=torch.float64) / xi[:, 3:6].norm(dim=-1))[:, None]
    if dim == 7:
        xi[:, 6] = torch.linspace(-2, 2, 200)
    torch.testing.assert_close(right_jacobian(xi), GROUPS[dim].left_jacobian(-xi), rtol=1e-10, atol=1e-10)


def test_the_residual_is_that_of_the_factor():
    poses, ii, jj, measured = random_graph(7, 0)
    factor = RelativePose(measured[None], torch.ones(1, 6, 7, dtype=torch.float64), ii, jj)
    linear = factor.linearise({"poses": poses[None]})
    e, j_i, j_j = residuals_and_jacobians(poses, ii, jj, measured)
    torch.testing.assert_close(linear.residual[0], e)
    torch.testing.assert_close(linear.jacobians[0][0], -j_i)
    torch.testing.assert_close(linear.jacobians[1][0], -j_j)


@pytest.mark.long
@pytest.mark.parametrize("solver", ["direct", "cg"])
@pytest.mark.parametrize("dim", [6, 7])
def test_the_minimum_is_that_of_scipy(dim: int, solver: str):
    from scipy.optimize import least_squares

    poses, ii, jj, measured = random_graph(dim, 3, angle=0.3)
    generator = torch.Generator().manual_seed(5)
    root = torch.randn(6, dim, dim, dtype=torch.float64, generator=generator)
    information = root.mT @ root + torch.eye(dim, dtype=torch.float64)
    whiten = torch.linalg.cholesky(information).mT
    group = GROUPS[dim]

    def residual(x: object) -> object:
        moved = group.retract(poses[1:], torch.as_tensor(x).view(-1, dim))
        e = residuals(torch.cat((poses[:1], moved)), ii, jj, measured)
        return (whiten @ e[..., None]).flatten().numpy()

    expected = least_squares(residual, torch.zeros(4 * dim).numpy(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    options = PoseGraphOptions(solver=LMOptions(max_iterations=200, tolerance=1e-13, solver=solver))  # type: ignore[arg-type]
    result = optimise_pose_graph(poses, ii, jj, measured, information, options)
    assert result.chi2 == pytest.approx(2 * expected.cost, rel=1e-7)
    assert torch.equal(result.poses_cw[0], poses[0])


def circle(count: int, scale_drift: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Poses of an estimate whose scale drifts around a circle, its edges, and the true camera-to-world poses.

    Edges along the way agree with the estimate; the last, of the loop, measures true motion and the change of scale.
    """
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    zero = torch.zeros_like(angle)
    turn = se3.exp(torch.stack((zero, zero, zero, zero, angle, zero), -1))
    true = torch.cat((torch.stack((5 * angle.sin(), zero, 5 * angle.cos()), -1), turn[:, 3:]), -1)
    motion = se3.relative(se3.inverse(true)[:-1], se3.inverse(true)[1:])
    ones = torch.ones(count - 1, dtype=torch.float64)
    # Each step believes the world to be a little larger than the one before.
    steps = sim3.from_se3(motion, ones * math.exp(scale_drift / count))
    poses = [sim3.from_se3(se3.inverse(true)[0])]
    for step in steps:
        poses.append(sim3.compose(step, poses[-1]))
    loop = sim3.from_se3(se3.relative(se3.inverse(true)[-1], se3.inverse(true)[0]))[None]
    index = torch.arange(count)
    return torch.stack(poses), index, (index + 1) % count, torch.cat((steps, loop)), true


def centres(sims_cw: Tensor) -> Tensor:
    """Camera centres in the world, of similarities."""
    return sim3.inverse(sims_cw)[:, :3]


def test_a_loop_takes_drift_of_scale_away():
    poses, ii, jj, measured, true = circle(60, 0.8)
    before = (centres(poses) - true[:, :3]).norm(dim=-1).max()
    information = torch.ones(60, 7, dtype=torch.float64)
    information[-1] = 1e4
    result = optimise_pose_graph(poses, ii, jj, measured, information)
    after = (centres(result.poses_cw) - true[:, :3]).norm(dim=-1).max()
    assert before > 2.0 and after < 0.3 * before
    scale = result.poses_cw[:, 7]
    assert result.converged and poses[:, 7].max() > 2.1 and scale[-1] == pytest.approx(1, abs=0.05)


def test_consistent_similarities_are_recovered():
    """From a disturbed start, measurements without error give back the poses and their scales."""
    generator = torch.Generator().manual_seed(0)
    poses, ii, jj, _, _ = circle(40, 0.5)
    ii, jj = torch.cat((ii, ii)), torch.cat((jj, (ii + 7) % 40))
    measured = sim3.compose(poses[jj], sim3.inverse(poses[ii]))
    disturbed = sim3.retract(poses, 0.05 * torch.randn(40, 7, dtype=torch.float64, generator=generator))
    disturbed[0] = poses[0]
    result = optimise_pose_graph(disturbed, ii, jj, measured)
    assert result.chi2 < 1e-12 * result.initial_chi2
    torch.testing.assert_close(centres(result.poses_cw), centres(poses), rtol=1e-6, atol=1e-6)


@pytest.mark.long
def test_a_kernel_limits_a_false_loop():
    poses, ii, jj, _, _ = circle(40, 0.0)
    measured = sim3.compose(poses[jj], sim3.inverse(poses[ii]))
    ii, jj = torch.cat((ii, torch.tensor([3]))), torch.cat((jj, torch.tensor([25])))
    measured = torch.cat((measured, sim3.identity(1, dtype=torch.float64)))
    information = torch.full((41, 7), 100.0, dtype=torch.float64)
    error = []
    for kernel in (Kernel("none"), Kernel("cauchy", 1.0)):
        result = optimise_pose_graph(poses, ii, jj, measured, information, PoseGraphOptions(kernel=kernel))
        error.append(float((centres(result.poses_cw) - centres(poses)).norm(dim=-1).max()))
    assert error[0] > 1 and error[1] < 0.1 * error[0]


def drifted(dim: int = 6, laps: int = 2, lap: int = 30, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Laps in three dimensions with much drift: poses by chaining the motions, edges, and a full information."""
    poses, ii, jj, measured, weight = make_laps(laps * lap, lap=lap, every=2, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.tensor([0.05] * 3 + [0.03] * 3 + [0.02], dtype=torch.float64)
    measured = sim3.normalise(
        sim3.compose(sim3.exp(noise * torch.randn(len(ii), 7, dtype=torch.float64, generator=generator)), measured)
    )
    chain = [poses[0]]
    for motion in measured[: len(poses) - 1]:
        chain.append(sim3.compose(motion, chain[-1]))
    poses = torch.stack(chain)
    mix = torch.randn(len(ii), dim, dim, dtype=torch.float64, generator=generator) * 0.3
    information = mix @ mix.mT + torch.eye(dim, dtype=torch.float64)
    if dim == 6:
        poses, measured = poses[:, :7], measured[:, :7]
    return poses, ii, jj, measured, 100 * information


def with_solver(solver: str, **changes: object) -> PoseGraphOptions:
    return PoseGraphOptions(solver=LMOptions(max_iterations=200, tolerance=1e-12, solver=solver), **changes)  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize("kernel", [Kernel("none"), Kernel("huber", 1.0), Kernel("cauchy", 2.0)])
@pytest.mark.parametrize("dim", [6, 7])
def test_both_factorisations_end_at_the_same_chi2(dim: int, kernel: Kernel):
    pytest.importorskip("scipy")
    found = [optimise_pose_graph(*drifted(dim), with_solver(s, kernel=kernel)) for s in ("fronts", "tiles")]
    assert found[0].chi2 == pytest.approx(found[1].chi2, rel=1e-8) and found[0].start == found[1].start
    torch.testing.assert_close(found[0].poses_cw, found[1].poses_cw, rtol=1e-4, atol=1e-4)


def test_without_the_extra_the_tiles_are_used(monkeypatch: pytest.MonkeyPatch):
    def never(*_: object) -> None:
        raise AssertionError("fronts without SciPy")

    graph = drifted()
    expected = optimise_pose_graph(*graph, with_solver("tiles"))
    monkeypatch.setattr("dvo.ba.pose_graph.scipy_is_installed", lambda: False)
    monkeypatch.setattr("dvo.ba.sparse.block_matrix.solve_fronts", never)
    found = optimise_pose_graph(*graph, with_solver("auto"))
    assert torch.equal(found.poses_cw, expected.poses_cw)
    monkeypatch.setattr("dvo.ba.pose_graph.scipy_is_installed", lambda: True)
    with pytest.raises((AssertionError, DvoError)):
        optimise_pose_graph(*graph, with_solver("auto"))


def test_the_start_of_least_chi2_is_taken_and_told():
    poses, ii, jj, measured, information = drifted()
    best = optimise_pose_graph(poses, ii, jj, measured, information)
    assert best.start != "given" and best.chi2 <= best.start_chi2 < best.initial_chi2
    given_chi2 = optimise_pose_graph(poses, ii, jj, measured, information, PoseGraphOptions(solver=LMOptions(0)))
    assert best.initial_chi2 == pytest.approx(given_chi2.chi2, rel=1e-12) and given_chi2.start == "given"
    again = optimise_pose_graph(best.poses_cw, ii, jj, measured, information)
    assert again.start == "given" and again.start_chi2 == again.initial_chi2 == pytest.approx(best.chi2, rel=1e-9)


def test_a_trajectory_tracked_with_loops_keeps_its_start_and_its_solver(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dvo.ba.sparse.block_matrix.solve_fronts", None)
    result = optimise_pose_graph(*drifted(7), LOOP_OPTIONS)
    assert result.start == "given" and result.start_chi2 == result.initial_chi2 and result.chi2 < result.initial_chi2


@pytest.mark.parametrize("dim", [6, 7])
def test_any_start_is_far_enough_for_consistent_measurements(dim: int):
    """Each pose is turned at random; the relative poses have no error, some edges are against the way or double."""
    poses, ii, jj, _, information = drifted(dim)
    group = GROUPS[dim]
    flip = torch.arange(len(ii)) % 3 == 0
    ii, jj = torch.where(flip, jj, ii), torch.where(flip, ii, jj)
    ii, jj, information = (torch.cat((x, x[:7])) for x in (ii, jj, information))
    measured = group.compose(poses[jj], group.inverse(poses[ii]))
    generator = torch.Generator().manual_seed(1)
    lost = group.retract(poses, 2 * torch.randn(len(poses), dim, dtype=torch.float64, generator=generator))
    lost[0] = poses[0]
    result = optimise_pose_graph(lost, ii, jj, measured, information)
    assert result.start != "given" and result.start_chi2 < 1e-8 * result.initial_chi2
    torch.testing.assert_close(centres_of(result.poses_cw), centres_of(poses), rtol=1e-6, atol=1e-6)


def centres_of(poses_cw: Tensor) -> Tensor:
    return GROUPS[poses_cw.shape[-1] - 1].inverse(poses_cw)[:, :3]


@pytest.mark.parametrize("solver", ["fronts", "tiles"])
def test_parts_that_no_edge_joins(solver: str):
    """Two parts, of which only the first has a pose that stays, a pose alone, and an edge of a pose with itself."""
    poses, ii, jj, measured, information = drifted()
    count = len(poses)
    both = torch.cat((poses, poses.roll(1, 0), poses[:1]))
    loop = torch.tensor([3])
    ends = [torch.cat((x, x + count, loop)) for x in (ii, jj)]
    motion = torch.cat((measured, measured, se3.identity(1, dtype=torch.float64)))
    weight = torch.cat((information, information, information[:1]))
    one = optimise_pose_graph(poses, ii, jj, measured, information, with_solver(solver))
    two = optimise_pose_graph(both, *ends, motion, weight, with_solver(solver))
    assert two.converged and two.chi2 == pytest.approx(2 * one.chi2, rel=1e-6)
    torch.testing.assert_close(two.poses_cw[:count], one.poses_cw, rtol=1e-4, atol=1e-4)
    assert torch.equal(two.poses_cw[-1], both[-1])
    free = optimise_pose_graph(poses, ii, jj, measured, information, with_solver(solver, fixed=0))
    assert free.chi2 == pytest.approx(one.chi2, rel=1e-6)


@pytest.mark.parametrize("solver", ["fronts", "tiles"])
def test_information_that_is_singular_or_unequal(solver: str):
    """Edges without any information, of directions only, and a million times that of the others."""
    poses, ii, jj, measured, information = drifted()
    true = optimise_pose_graph(poses, ii, jj, measured, information).poses_cw
    measured = se3.compose(true[jj], se3.inverse(true[ii]))
    information = information.clone()
    loops = torch.arange(len(poses), len(ii))
    information[loops[::4]] = 0
    measured[loops[::4]] = se3.identity(1, dtype=torch.float64)
    information[loops[1::4]] = torch.diag(torch.tensor([1.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    information[loops[2::4]] *= 1e6
    result = optimise_pose_graph(poses, ii, jj, measured, information, with_solver(solver))
    assert result.chi2 < 1e-9 * result.initial_chi2
    torch.testing.assert_close(result.poses_cw, true, rtol=1e-4, atol=1e-4)


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(CHARTS), st.integers(0, 10_000), st.sampled_from([1e-6, 0.05, 1.0, 3.0]))
def test_edges_in_the_plane_are_those_in_space(chart: Chart, seed: int, size: float):
    xi = torch.zeros(40, 6, dtype=torch.float64)
    xi[:, PLANE] = size * torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    poses, measured = se3.exp(xi).split((10, 30))
    ii, jj = torch.randint(0, 10, (2, 30), generator=torch.Generator().manual_seed(seed))
    found = planar_edges(poses, ii, jj, measured, chart, True)
    e, j_i, j_j = residuals_and_jacobians(poses, ii, jj, measured, chart)
    axes = list(PLANE)
    assert in_plane(poses, measured, None)
    keep = found[0][:, 2].abs() < (0.999 if chart == "quaternion" else 3.13)  # pi may be told as -pi
    for own, full in zip(found, (e[:, axes], j_i[:, axes][..., axes], j_j[:, axes][..., axes]), strict=True):
        assert own is not None
        torch.testing.assert_close(own[keep], full[keep], rtol=1e-9, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("outside", [0.0, 1.0, 1e12])
def test_a_graph_in_the_plane_does_not_depend_on_information_outside_it(outside: float):
    poses, ii, jj, measured, information = drifted()
    keep = poses.new_tensor([1, 1, 0, 0, 0, 1, 1])
    poses, measured = (se3.normalise(x * keep + x.new_tensor([0, 0, 0, 0, 0, 0, 1e-3])) for x in (poses, measured))
    rest = [2, 3, 4]
    information[:, rest] = information[:, :, rest] = 0
    information[:, rest, rest] = outside
    assert in_plane(poses, measured, information)
    result = optimise_pose_graph(poses, ii, jj, measured, information, with_solver("auto"))
    assert (result.poses_cw[:, 2:5] == 0).all()
    # The same graph in another plane has six coordinates, and a lower minimum outside it where nothing holds it there.
    tilt = se3.exp(torch.tensor([0.1, 0.2, 0.3, 0.4, -0.5, 0.6], dtype=torch.float64))
    information[:, rest, rest] = 1e12
    world = se3.compose(poses, tilt.expand_as(poses))
    assert not in_plane(world, measured, information)
    full = optimise_pose_graph(world, ii, jj, measured, information, with_solver("auto"))
    assert full.chi2 == pytest.approx(result.chi2, rel=1e-5)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_reading_a_planar_file(tmp_path: Path):
    file = write(
        tmp_path / "a.g2o",
        "VERTEX_SE2 4 1 2 0.5\nVERTEX_SE2 2 0 0 0\nEDGE_SE2 2 4 1 2 0.4 1 2 3 4 5 6\nFIX 2\n",
    )
    graph = read_g2o(file)
    assert graph.ii.tolist() == [1] and graph.jj.tolist() == [0] and graph.chart == "split"
    assert graph.information[0, :, 5].tolist() == [3, 5, 0, 0, 0, 6]
    e = residuals(graph.poses_cw, graph.ii, graph.jj, graph.measurements, graph.chart)[0]
    torch.testing.assert_close(e, torch.tensor([0, 0, 0, 0, 0, 0.1], dtype=torch.float64))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 2 0 1 0 0 1 0 1\n",
        "VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 0 1 2 0 1 0 0\n",
        "VERTEX_SE2 0 0 0 zero\nEDGE_SE2 0 0 1 2 0 1 0 0 1 0 1\n",
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, text: str):
    file = write(tmp_path / "b.g2o", text)
    with pytest.raises(DvoError, match="b.g2o"):
        read_g2o(file)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("poses_cw", lambda a: [a[0][:, :6], *a[1:]]),
        ("jj", lambda a: [*a[:2], a[2] + 1, *a[3:]]),
        ("measurements", lambda a: [*a[:3], a[3][:-1], *a[4:]]),
        ("information", lambda a: [*a[:4], -torch.eye(6).expand(6, 6, 6)]),
        ("information", lambda a: [*a[:4], torch.ones(6, 7)]),
    ],
)
def test_bad_input_is_named(field: str, change: object):
    with pytest.raises(DvoError) as error:
        optimise_pose_graph(*change([*random_graph(6, 0), None]))  # type: ignore[operator]
    assert error.value.field == field


def test_the_benchmark_prints_the_start_and_the_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from eval.benchmarks import pose_graph as benchmark

    file = str(Path(__file__).parent / "rendered_loop.g2o")
    monkeypatch.setattr("sys.argv", ["pose_graph", "--chart", "log", "--gtsam", "--repeat", "2", file])
    monkeypatch.setattr(benchmark, "gtsam_minimum", lambda _: (5.75, 0.5))
    benchmark.main()
    header, row = capsys.readouterr().out.splitlines()
    for words, word in (("chi2 given", "given"), ("chi2 of it", "of_it"), ("cpu s", "cpu")):
        header = header.replace(words, word)
    told = dict(zip(header.split(), row.split(), strict=True))
    assert told["start"] in ("given", "tree", "relaxation") and told["GTSAM"] == "5.750000"
    assert float(told["of_it"]) <= float(told["given"]) and float(told["after"]) == pytest.approx(5.800921, abs=1e-5)
    assert float(told["ratio"]) >= 0


@pytest.fixture(scope="module")
def folder(data_root: Path) -> Path:
    path = data_root / "posegraph"
    if not path.is_dir():
        pytest.skip(f"no pose graphs at {path}")
    return path


@pytest.mark.long
def test_the_initial_chi2_of_every_file(folder: Path):
    expected = json.loads((folder / "initial_chi2.json").read_text(encoding="utf-8"))
    assert len(expected) >= 8
    for name, values in expected.items():
        graph = read_g2o(folder / name)
        options = PoseGraphOptions(chart=graph.chart, solver=LMOptions(max_iterations=0))
        result = optimise_pose_graph(*arguments(graph), options)
        assert result.initial_chi2 == pytest.approx(values["initial_chi2_g2o_convention"], rel=1e-9), name


def arguments(graph: PoseGraph) -> tuple[Tensor, ...]:
    return graph.poses_cw, graph.ii, graph.jj, graph.measurements, graph.information


# Final errors of GTSAM 4.3.0 (Levenberg-Marquardt, relative and absolute tolerance 1e-10), times two. GTSAM takes the
# information of a file as that of the logarithm.
@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "chi2"),
    [
        ("ring.g2o", 11.163101488554025),
        ("mit.g2o", 770.2389838995721),
        ("sphere2500.g2o", 1351.4019258518795),
        pytest.param("M3500.g2o", 137.91487824746932, marks=pytest.mark.slow),
        pytest.param("parking-garage.g2o", 1.2683847992644874, marks=pytest.mark.slow),
    ],
)
def test_the_final_chi2_is_that_of_gtsam(folder: Path, name: str, chi2: float):
    graph = read_g2o(folder / name)
    result = optimise_pose_graph(*arguments(graph), PoseGraphOptions(chart="log", start="given"))
    assert result.converged and result.chi2 == pytest.approx(chi2, rel=1e-4)


def test_the_final_chi2_of_a_rendered_loop_is_that_of_gtsam():
    """Pose graph of the tracker on a rendered walk there and back, scales left out; GTSAM as above."""
    graph = read_g2o(Path(__file__).parent / "rendered_loop.g2o")
    result = optimise_pose_graph(*arguments(graph), PoseGraphOptions(chart="log"))
    assert result.initial_chi2 == pytest.approx(35.675317653438256, rel=1e-6)
    assert result.converged and result.chi2 == pytest.approx(5.800920988659587, rel=1e-6)


# Global minima; from the poses of the files Levenberg-Marquardt ends at 770.2, 59900 and 10492.
@pytest.mark.parametrize(
    ("name", "chi2"),
    [
        ("mit.g2o", 41.206947),
        pytest.param("intel.g2o", 215.8393, marks=pytest.mark.slow),
        pytest.param("torus3D.g2o", 24235.27378, marks=pytest.mark.slow),
    ],
)
def test_the_start_avoids_a_local_minimum(folder: Path, name: str, chi2: float):
    pytest.importorskip("scipy")  # for its time
    result = optimise_pose_graph(*arguments(read_g2o(folder / name)), PoseGraphOptions(chart="log"))
    assert result.converged and result.start != "given" and result.chi2 == pytest.approx(chi2, rel=1e-5)
