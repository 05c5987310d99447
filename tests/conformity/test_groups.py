"""Rotations, rigid motions and similarities against GTSAM, pypose and kornia.

GTSAM orders a tangent rotation first, and its derivatives are right Jacobians. Its similarity maps ``p`` to
``s (R p + t)``, ours to ``s R p + t``: the same groups with the same tangents, in which only the translation is written
in another unit. pypose and kornia order and act as dvo does.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dvo.geometry import se3, sim3, so3

pytestmark = pytest.mark.peers
ANGLES = [0.0, 1e-7, 1e-3, 0.1, 1.0, 3.0]
DIMENSIONS = {"so3": 3, "se3": 6, "sim3": 7}


def tangents(name: str, angle: float, count: int = 6) -> Tensor:
    """Tangents ``(count, D)`` ``[tau, phi, sigma]`` with rotations by an angle, radians."""
    generator = torch.Generator().manual_seed(int(1e6 * angle) + len(name))
    xi = torch.randn(count, 7, dtype=torch.float64, generator=generator)
    xi[:, 3:6] *= angle / xi[:, 3:6].norm(dim=-1, keepdim=True)
    return {"so3": xi[:, 3:6], "se3": xi[:, :6], "sim3": xi}[name]


def rotation_first(xi: Tensor) -> np.ndarray:
    """A tangent in GTSAM's order."""
    return torch.cat((xi[..., 3:6], xi[..., :3], xi[..., 6:]), -1).numpy()


def swapped(matrix: np.ndarray) -> Tensor:
    """A matrix on tangents in GTSAM's order as one on dvo's."""
    order = [3, 4, 5, 0, 1, 2, 6][: len(matrix)]
    return torch.from_numpy(matrix[np.ix_(order, order)].copy())


def close(found: Tensor, expected: Tensor, atol: float = 1e-9) -> None:
    torch.testing.assert_close(found, expected.to(found), atol=atol, rtol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_gtsam_rigid_motions(angle: float) -> None:
    gtsam = pytest.importorskip("gtsam", reason="pip install gtsam")
    point = np.array([0.3, -0.7, 2.0])
    for xi, other in zip(tangents("se3", angle), tangents("se3", 0.5), strict=True):
        pose, theirs = se3.exp(xi), gtsam.Pose3.Expmap(rotation_first(xi))
        close(se3.matrix(pose), torch.from_numpy(theirs.matrix()))
        close(se3.log(pose), swapped_vector(gtsam.Pose3.Logmap(theirs)))
        close(se3.adjoint(pose), swapped(theirs.AdjointMap()))
        close(se3.left_jacobian(-xi), swapped(gtsam.Pose3.ExpmapDerivative(rotation_first(xi))), 1e-7)
        second = gtsam.Pose3.Expmap(rotation_first(other))
        close(se3.matrix(se3.compose(pose, se3.exp(other))), torch.from_numpy(theirs.compose(second).matrix()))
        between = theirs.inverse().compose(second).matrix()
        close(se3.matrix(se3.compose(se3.inverse(pose), se3.exp(other))), torch.from_numpy(between))
        close(se3.act(pose, torch.from_numpy(point)[None])[0], torch.from_numpy(theirs.transformFrom(point)))


def swapped_vector(xi: np.ndarray) -> Tensor:
    """A tangent in GTSAM's order as one in dvo's."""
    return torch.from_numpy(np.concatenate((xi[3:6], xi[:3], xi[6:])))


@pytest.mark.parametrize("angle", ANGLES)
def test_gtsam_rotations(angle: float) -> None:
    gtsam = pytest.importorskip("gtsam", reason="pip install gtsam")
    for phi in tangents("so3", angle):
        theirs = gtsam.Rot3.Expmap(phi.numpy())
        close(so3.matrix(so3.exp(phi)), torch.from_numpy(theirs.matrix()))
        close(so3.log(so3.exp(phi)), torch.from_numpy(gtsam.Rot3.Logmap(theirs)))
        quaternion = theirs.toQuaternion()
        ours = so3.from_matrix(torch.from_numpy(theirs.matrix()))
        found = torch.tensor([quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()], dtype=torch.float64)
        close(ours * torch.sign(ours @ found), found)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.1, 1.0, 3.0])
def test_gtsam_similarities(angle: float) -> None:
    gtsam = pytest.importorskip("gtsam", reason="pip install gtsam")
    points = torch.tensor([[0.3, -0.7, 2.0]], dtype=torch.float64)
    for xi in tangents("sim3", angle):
        similarity, theirs = sim3.exp(xi), gtsam.Similarity3.Expmap(rotation_first(xi))
        scale = theirs.scale()
        close(similarity[7], torch.tensor(scale, dtype=torch.float64))
        close(so3.matrix(similarity[3:7]), torch.from_numpy(theirs.rotation().matrix()))
        close(similarity[:3], torch.from_numpy(scale * theirs.translation()), 1e-8)
        close(sim3.act(similarity, points)[0], torch.from_numpy(theirs.transformFrom(points[0].numpy())), 1e-8)
        close(sim3.log(similarity), swapped_vector(gtsam.Similarity3.Logmap(theirs)), 1e-8)
        close(sim3.adjoint(similarity), swapped(theirs.AdjointMap()), 1e-8)


@pytest.mark.parametrize("angle", ANGLES[1:])
@pytest.mark.parametrize("name", DIMENSIONS)
def test_pypose(name: str, angle: float) -> None:
    pypose = pytest.importorskip("pypose", reason="pip install pypose")
    group = {"so3": so3, "se3": se3, "sim3": sim3}[name]
    xi, other = tangents(name, angle), tangents(name, 0.5)
    theirs, second = getattr(pypose, name)(xi).Exp(), getattr(pypose, name)(other).Exp()
    ours = group.exp(xi)
    close(ours, theirs.tensor(), 1e-7)
    close(group.log(theirs.tensor()), theirs.Log().tensor(), 1e-7)
    matrix = theirs.matrix()[..., :3, :3] if name == "so3" else theirs.matrix()
    close(group.matrix(ours), matrix, 1e-7)
    compose = so3.multiply if name == "so3" else group.compose
    close(compose(ours, group.exp(other)), (theirs @ second).tensor(), 1e-7)
    if name != "so3":
        close(group.inverse(ours), theirs.Inv().tensor(), 1e-7)
        moved = theirs.Adj(getattr(pypose, name)(other)).tensor()
        close((group.adjoint(ours) @ other[..., None])[..., 0], moved, 1e-7)


@pytest.mark.parametrize("angle", ANGLES[2:])
def test_kornia(angle: float) -> None:
    liegroup = pytest.importorskip("kornia.geometry.liegroup", reason="pip install kornia")
    xi = tangents("se3", angle)
    pose, theirs = se3.exp(xi), liegroup.Se3.exp(xi)
    close(se3.matrix(pose), theirs.matrix(), 1e-7)
    close(se3.adjoint(pose), theirs.adjoint(), 1e-7)
    close(se3.log(pose), theirs.log(), 1e-6)
    phi = tangents("so3", angle)
    close(so3.matrix(so3.exp(phi)), liegroup.So3.exp(phi).matrix(), 1e-7)
    turn = torch.cat((torch.zeros_like(phi), phi), -1)
    close(se3.left_jacobian(turn)[..., 3:, 3:], liegroup.So3.left_jacobian(phi), 1e-6)
    close(se3.left_jacobian(-turn)[..., 3:, 3:], liegroup.So3.right_jacobian(phi), 1e-6)
