"""Real bundle adjustment problems: the reader, and the cost that scipy reaches from the same start."""

from __future__ import annotations

import bz2
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dvo.ba.bal import PointProblem, read_bal
from dvo.ba.points import residuals, solve_points
from dvo.core.errors import DvoError
from dvo.core.kernels import CHOICES, VARIABLE
from dvo.geometry import se3

FILES = ["dubrovnik-3-7-pre.txt", "problem-21-11315-pre.txt", "problem-49-7776-pre.txt"]
GBP = ["fr1desk.txt", "fr1desk_small.txt", "fr1desk_vsmall.txt", "fr1xyz_av.txt", "fr2robot2.txt"]


@pytest.fixture(scope="module")
def bal(data_root: Path) -> Path:
    return data_root / "bal"


@pytest.mark.parametrize("name", FILES + [f"gbp/{name}" for name in GBP])
def test_initial_cost_of_the_shared_problems(bal: Path, name: str) -> None:
    expected = json.loads((bal / "initial_costs.json").read_text())[name]
    problem = read_bal(bal / name)
    assert len(problem.poses_cw) == expected["cameras"]
    assert len(problem.points) == expected["points"]
    assert len(problem.pixels) == expected["observations"]
    errors = residuals(problem)
    assert np.isclose(float(errors.square().sum(-1).mean()) ** 0.5, expected["initial_rmse_px"], rtol=1e-10)
    if "initial_half_sq_cost" in expected:
        assert np.isclose(0.5 * float(errors.square().sum()), expected["initial_half_sq_cost"], rtol=1e-10)


def scipy_cost(path: Path) -> float:
    """Least squares over angle-axis poses and points, from the numbers of the file and nothing of ours."""
    optimize, sparse = pytest.importorskip("scipy.optimize"), pytest.importorskip("scipy.sparse")
    numbers = np.array(" ".join(x for x in path.read_text().splitlines() if not x.startswith("#")).split(), float)
    c, k, o = (int(x) for x in numbers[:3])
    classic = len(numbers) == 3 + 4 * o + 9 * c + 3 * k
    start = 3 if classic else 7
    seen = numbers[start : start + 4 * o].reshape(-1, 4)
    camera, point, pixels = seen[:, 0].astype(int), seen[:, 1].astype(int), seen[:, 2:]
    cameras = numbers[start + 4 * o : len(numbers) - 3 * k].reshape(c, -1)
    world = numbers[len(numbers) - 3 * k :]
    # rotation first, as in BAL
    poses = cameras[:, :6] if classic else np.concatenate((cameras[:, 3:], cameras[:, :3]), 1)

    def fun(x: np.ndarray) -> np.ndarray:
        pose, p = x[: 6 * c].reshape(c, 6)[camera], x[6 * c :].reshape(k, 3)[point]
        angle = np.linalg.norm(pose[:, :3], axis=1, keepdims=True)
        axis = pose[:, :3] / np.where(angle > 0, angle, 1)
        along = (axis * p).sum(1, keepdims=True)
        p = p * np.cos(angle) + np.cross(axis, p) * np.sin(angle) + axis * along * (1 - np.cos(angle)) + pose[:, 3:]
        if not classic:
            return (p[:, :2] / p[:, 2:] * numbers[3:5] + numbers[5:7] - pixels).ravel()
        xy = -p[:, :2] / p[:, 2:]
        f, k1, k2 = cameras[camera, 6:].T[:, :, None]
        r2 = (xy**2).sum(1, keepdims=True)
        return (f * (1 + k1 * r2 + k2 * r2**2) * xy - pixels).ravel()

    x0 = np.concatenate((poses.ravel(), world))
    if len(x0) < 500:
        method = "lm" if 2 * o >= len(x0) else "trf"
        return optimize.least_squares(fun, x0, x_scale="jac", method=method, ftol=1e-6).cost
    pattern = sparse.lil_matrix((2 * o, 6 * c + 3 * k), dtype=int)
    rows = np.arange(o)
    for axis in range(2):
        for column in range(6):
            pattern[2 * rows + axis, 6 * camera + column] = 1
        for column in range(3):
            pattern[2 * rows + axis, 6 * c + 3 * point + column] = 1
    return optimize.least_squares(fun, x0, jac_sparsity=pattern, x_scale="jac", method="trf", ftol=1e-4).cost


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        "dubrovnik-3-7-pre.txt",
        pytest.param("gbp/fr2robot2.txt", marks=pytest.mark.slow),
        pytest.param("gbp/fr1desk.txt", marks=pytest.mark.slow),
        pytest.param("problem-21-11315-pre.txt", marks=pytest.mark.slow),
        pytest.param("problem-49-7776-pre.txt", marks=pytest.mark.slow),
    ],
)
def test_reaches_the_cost_of_scipy(bal: Path, name: str) -> None:
    solution = solve_points(read_bal(bal / name))
    theirs = scipy_cost(bal / name)
    print(f"{name}: ours {solution.cost:.6g} in {solution.iterations} steps, scipy {theirs:.6g}")
    assert solution.converged
    assert solution.cost <= 1.01 * theirs


def test_reaches_the_cost_of_scipy_on_a_part_of_a_real_problem(bal: Path, tmp_path: Path) -> None:
    """Five cameras of the 21 and sixty points that at least three of them see."""
    lines = (bal / FILES[1]).read_text().split()
    c, k, o = (int(x) for x in lines[:3])
    seen = np.array(lines[3 : 3 + 4 * o]).reshape(o, 4)
    camera, point = seen[:, 0].astype(int), seen[:, 1].astype(int)
    often = np.flatnonzero(np.bincount(point[camera < 5], minlength=k) >= 3)[:60]
    keep = (camera < 5) & np.isin(point, often)
    rows = [f"{a} {np.searchsorted(often, b)} {x} {y}" for a, b, (x, y) in zip(
        camera[keep], point[keep], seen[keep, 2:], strict=True)]  # fmt: skip
    rest = lines[3 + 4 * o :]
    world = np.array(rest[9 * c :]).reshape(k, 3)[often]
    small = tmp_path / "small.txt"
    small.write_text("\n".join([f"5 60 {len(rows)}", *rows, *rest[:45], *world.ravel()]))
    solution = solve_points(read_bal(small))
    assert solution.initial_cost > 1.1 * solution.cost
    assert abs(solution.cost / scipy_cost(small) - 1) < 0.01


def synthetic(noise: float = 0.0) -> tuple[PointProblem, PointProblem]:
    """A problem at its solution, and the same from a disturbed start."""
    generator = torch.Generator().manual_seed(0)
    random = torch.randn(400, dtype=torch.float64, generator=generator)
    points = random[:90].view(30, 3) + torch.tensor([0.0, 0, 6], dtype=torch.float64)
    poses = se3.exp(0.1 * random[90:120].view(5, 6))
    camera, point = torch.arange(5).repeat_interleave(30), torch.arange(30).repeat(5)
    intrinsics = torch.tensor([400.0, 410, 320, 240], dtype=torch.float64).expand(5, 4)
    radial = torch.tensor([-0.1, 0.02], dtype=torch.float64).expand(5, 2)
    zero = torch.zeros(150, 2, dtype=torch.float64)
    truth = PointProblem(poses, intrinsics, radial, points, camera, point, zero)
    seen = -residuals(truth) + noise * torch.randn(150, 2, dtype=torch.float64, generator=generator)
    truth = PointProblem(poses, intrinsics, radial, points, camera, point, seen)
    disturbed = se3.retract(poses, 0.02 * random[120:150].view(5, 6))
    disturbed[:2] = poses[:2]
    return truth, truth.moved(disturbed, points + 0.1 * random[150:240].view(30, 3))


def test_exact_measurements_are_fitted_exactly_and_fixed_cameras_stay() -> None:
    truth, start = synthetic()
    solution = solve_points(start, fixed=2, tolerance=1e-12)
    assert solution.cost < 1e-12
    assert torch.equal(solution.problem.poses_cw[:2], start.poses_cw[:2])
    # two fixed cameras fix the scale as well
    torch.testing.assert_close(solution.problem.poses_cw, truth.poses_cw, atol=1e-6, rtol=0)
    torch.testing.assert_close(solution.problem.points, truth.points, atol=1e-5, rtol=0)


def test_the_cost_never_rises_and_the_result_is_stationary() -> None:
    _, start = synthetic(noise=1.0)
    costs = [solve_points(start, max_iterations=n).cost for n in range(8)]
    assert costs[0] == solve_points(start).initial_cost
    assert all(b <= a for a, b in zip(costs, costs[1:], strict=False))
    best = solve_points(start, tolerance=1e-14).problem
    xi = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)
    points = best.points.clone().requires_grad_()
    residuals(best.moved(se3.retract(best.poses_cw, xi), points)).square().sum().backward()
    assert xi.grad is not None and points.grad is not None
    assert xi.grad.abs().max() < 0.1 and points.grad.abs().max() < 0.1  # at the start thousands


def test_degenerate_problems_end() -> None:
    truth, start = synthetic()
    only = torch.zeros(1, dtype=torch.long)
    one = PointProblem(*(x[:1] for x in (start.poses_cw, start.intrinsics, start.radial, start.points)), only, only,
                       start.pixels[:1])  # fmt: skip
    assert np.isfinite(solve_points(one).cost)
    assert solve_points(truth).cost < 1e-12  # already there
    behind = start.moved(start.poses_cw, -start.points)
    assert np.isfinite(solve_points(behind, max_iterations=20).cost)
    unseen = start.moved(start.poses_cw, torch.cat((start.points, torch.ones(1, 3, dtype=torch.float64))))
    torch.testing.assert_close(solve_points(unseen).problem.points[-1], torch.ones(3, dtype=torch.float64))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 10_000), st.integers(0, 5), st.integers(0, 150), st.integers(1, 4))
def test_the_kernels_take_the_steps_of_the_twin(
    monkeypatch: pytest.MonkeyPatch, seed: int, fixed: int, count: int, iterations: int
) -> None:
    """Of some observations, some of them twice, in any order."""
    _, start = synthetic(noise=1.0)
    some = torch.randint(150, (count,), generator=torch.Generator().manual_seed(seed))
    start = replace(start, camera=start.camera[some], point=start.point[some], pixels=start.pixels[some])
    found = []
    for choice in CHOICES:
        monkeypatch.setenv(VARIABLE, choice)
        found.append(solve_points(start, fixed=fixed, max_iterations=iterations))
    ours, twin = found
    assert (ours.iterations, ours.converged) == (twin.iterations, twin.converged)
    assert ours.initial_cost == pytest.approx(twin.initial_cost, rel=1e-9)
    if count >= 100 and fixed >= 2:  # else what the measurements leave open is open to rounding, too
        assert ours.cost == pytest.approx(twin.cost, rel=1e-6)
        torch.testing.assert_close(ours.problem.poses_cw, twin.problem.poses_cw, atol=1e-6, rtol=0)
        torch.testing.assert_close(ours.problem.points, twin.problem.points, atol=1e-4, rtol=1e-4)
    else:
        assert ours.cost == pytest.approx(twin.cost, rel=1e-2, abs=1e-3)


TINY = "1 1 1\n0 0 10.0 20.0\n" + " ".join(["0"] * 6 + ["100", "0", "0"]) + "\n0 0 -2\n"


def test_the_conventions_of_the_file(tmp_path: Path) -> None:
    """BAL looks down -z and measures y upwards; inside, z is forward and y down."""
    file = tmp_path / "tiny.txt"
    file.write_text(TINY)
    problem = read_bal(file)
    torch.testing.assert_close(problem.pixels, torch.tensor([[10.0, -20.0]], dtype=torch.float64))
    torch.testing.assert_close(residuals(problem), problem.pixels)  # the point lies on the axis, two ahead
    torch.testing.assert_close(
        se3.act(problem.poses_cw, problem.points), torch.tensor([[0.0, 0, 2]], dtype=torch.float64)
    )
    packed = tmp_path / "tiny.txt.bz2"
    packed.write_bytes(bz2.compress(TINY.encode()))
    torch.testing.assert_close(read_bal(packed).poses_cw, problem.poses_cw)


@pytest.mark.parametrize(
    "text",
    ["", "1 1", TINY[:-3], TINY + "1 1", TINY.replace("10.0", "ten"), TINY.replace("0 0 10.0", "1 0 10.0"), "\x00\xff"],
)
def test_broken_files(tmp_path: Path, text: str) -> None:
    file = tmp_path / "broken.txt"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(DvoError, match="broken.txt"):
        read_bal(file)
    packed = tmp_path / "broken.bz2"
    packed.write_bytes(text.encode("latin-1"))
    with pytest.raises(DvoError, match=r"broken.bz2"):
        read_bal(packed)
    with pytest.raises(DvoError, match="no such file"):
        read_bal(tmp_path / "none.txt")
