"""The minimum of a random bundle adjustment problem against GTSAM's.

The problem is written twice: as dvo's patches, whose position in their own frame is exact and whose depth is
unknown, and as factors of GTSAM between two poses and an inverse depth, by its own poses and camera.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BADamping, BAOptions, bundle_adjust
from dvo.ba.sparse.global_adjust import GlobalBAOptions, global_bundle_adjust
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3

pytestmark = pytest.mark.peers
FRAMES, PATCHES = 5, 12
FOCAL, CENTRE = 120.0, 64.0


def problem(seed: int = 0) -> dict[str, torch.Tensor]:
    """Frames on an arc, each with patches that all others see with half a pixel of noise; disturbed starting values."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    steps = torch.tensor([[0.35, 0.05, 0.02, 0.01, -0.03, 0.01]], dtype=torch.float64)
    poses = se3.exp(-steps * torch.arange(FRAMES, dtype=torch.float64)[:, None] + 0.01 * draw(FRAMES, 6))
    source = torch.arange(FRAMES).repeat_interleave(PATCHES)
    position = CENTRE + 25 * draw(len(source), 2).clamp(-1.8, 1.8)
    inverse_depth = 1 / (3 + torch.rand(len(source), dtype=torch.float64, generator=generator) * 3)
    kk, jj = (x.flatten() for x in torch.meshgrid(torch.arange(len(source)), torch.arange(FRAMES), indexing="ij"))
    keep = source[kk] != jj
    kk, jj = kk[keep], jj[keep]
    ii = source[kk]
    ray = torch.cat(((position - CENTRE) / FOCAL, torch.ones(len(source), 1, dtype=torch.float64)), -1)
    moved = se3.compose(poses[jj], se3.inverse(poses[ii]))
    seen = se3.act(moved[:, None], (ray / inverse_depth[:, None])[kk][:, None])[:, 0]
    targets = FOCAL * seen[:, :2] / seen[:, 2:] + CENTRE + 0.5 * draw(len(kk), 2)
    weights = 0.3 + torch.rand(len(kk), 2, dtype=torch.float64, generator=generator)
    disturbed = se3.retract(poses, 0.02 * draw(FRAMES, 6) * (torch.arange(FRAMES) > 1)[:, None])
    values = torch.cat((position, inverse_depth[:, None] * (1 + 0.1 * draw(len(source), 1))), -1)
    return {
        "poses_cw": disturbed, "patches": values[:, :, None, None],
        "intrinsics": torch.tensor([FOCAL, FOCAL, CENTRE, CENTRE], dtype=torch.float64).repeat(FRAMES, 1),
        "targets": targets, "weights": weights, "ii": ii, "jj": jj, "kk": kk,
    }  # fmt: skip


def by_gtsam(gtsam, given: dict[str, torch.Tensor]) -> tuple[torch.Tensor, np.ndarray, float]:
    """Poses ``(N, 4, 4)`` world to camera, inverse depths and cost at GTSAM's minimum; the first two poses are held."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    symbol = gtsam.symbol
    for number, matrix in enumerate(se3.matrix(se3.inverse(given["poses_cw"])).numpy()):
        pose = gtsam.Pose3(matrix)
        start.insert(symbol("x", number), pose)
        if number < 2:
            graph.add(gtsam.NonlinearEqualityPose3(symbol("x", number), pose))
    patches = given["patches"][:, :, 0, 0].numpy()
    for number, (_, _, inverse_depth) in enumerate(patches):
        start.insert(symbol("d", number), np.array([inverse_depth]))
    calibration = gtsam.Cal3_S2(FOCAL, FOCAL, 0.0, CENTRE, CENTRE)

    def factor(ray: np.ndarray, target: np.ndarray):
        def residual(first, second, inverse_depth):
            world = first.transformFrom(ray / inverse_depth)
            return gtsam.PinholeCameraCal3_S2(second, calibration).project(world) - target

        def error(this, values, jacobians):
            keys = this.keys()
            first, second = values.atPose3(keys[0]), values.atPose3(keys[1])
            depth = values.atVector(keys[2])[0]
            if jacobians is not None:
                step = 1e-6
                for which, dim in ((0, 6), (1, 6), (2, 1)):
                    columns = []
                    for k in range(dim):
                        d = step * np.eye(dim)[k]
                        ends = []
                        for sign in (1, -1):
                            arguments = [first, second, depth]
                            arguments[which] = depth + sign * d[0] if which == 2 else arguments[which].retract(sign * d)
                            ends.append(residual(*arguments))
                        columns.append((ends[0] - ends[1]) / (2 * step))
                    jacobians[which] = np.asfortranarray(np.stack(columns, 1))
            return residual(first, second, depth)

        return error

    rows = zip(*(given[name].tolist() for name in ("ii", "jj", "kk", "targets", "weights")), strict=True)
    for i, j, k, target, weight in rows:
        noise = gtsam.noiseModel.Diagonal.Precisions(np.array(weight))
        ray = np.array([*((patches[k, :2] - CENTRE) / FOCAL), 1.0])
        keys = [symbol("x", i), symbol("x", j), symbol("d", k)]
        graph.add(gtsam.CustomFactor(noise, keys, factor(ray, np.array(target))))
    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(1e-12)
    options.setAbsoluteErrorTol(1e-12)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, options).optimize()
    matrices = np.stack([found.atPose3(symbol("x", n)).inverse().matrix() for n in range(FRAMES)])
    depths = np.array([found.atVector(symbol("d", n))[0] for n in range(len(patches))])
    return torch.from_numpy(matrices), depths, graph.error(found)


@pytest.mark.long
def test_the_minimum_is_that_of_gtsam() -> None:
    """By the sparse solver and by the differentiable layer."""
    gtsam = pytest.importorskip("gtsam", reason="pip install gtsam")
    given = problem()
    poses, depths, cost = by_gtsam(gtsam, given)
    options = GlobalBAOptions(fixed=2, kernel=Kernel("none"), solver=LMOptions(max_iterations=50, tolerance=1e-14))
    sparse = global_bundle_adjust(**given, options=options)
    assert sparse.cost < sparse.initial_cost / 5 and sparse.cost == pytest.approx(cost, rel=1e-7)
    torch.testing.assert_close(se3.matrix(sparse.poses_cw), poses, atol=1e-6, rtol=0)
    np.testing.assert_allclose(sparse.patches[:, 2, 0, 0], depths, atol=1e-6)
    batch = {name: x if x.dtype == torch.long else x[None] for name, x in given.items()}
    dense = bundle_adjust(**batch, options=BAOptions(iterations=20, fixed=2, damping=BADamping(0.0, 1e-9, 0.0)))
    torch.testing.assert_close(se3.matrix(dense.poses_cw[0]), poses, atol=1e-5, rtol=0)
