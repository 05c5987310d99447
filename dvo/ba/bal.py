"""Bundle adjustment problems from files.

Two text formats are distinguished by their length:

* BAL (Agarwal et al., "Bundle Adjustment in the Large", 2010): per camera an angle-axis rotation, a translation, f,
  k1, k2; the camera looks down its negative z axis and measures y upwards from the image centre.
* the one of Ortiz et al. ("Bundle Adjustment on a Graph Processor", 2020): fx fy cx cy once; per camera a translation
  and an angle-axis rotation, world to camera, z forward.
"""

from __future__ import annotations

import bz2
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.geometry import so3


@dataclass(frozen=True)
class PointProblem:
    """Cameras, 3-D points and image measurements of the points. All float64, z forward, y down.

    Attributes:
        poses_cw: ``(C, 7)`` world to camera.
        intrinsics: ``(C, 4)`` fx fy cx cy.
        radial: ``(C, 2)`` k1 k2: a point at normalised ``x`` projects to ``f (1 + k1 |x|^2 + k2 |x|^4) x + c``.
        points: ``(K, 3)`` in the world.
        camera, point: ``(O,)`` camera and point of each measurement.
        pixels: ``(O, 2)`` measured position.
    """

    poses_cw: Tensor
    intrinsics: Tensor
    radial: Tensor
    points: Tensor
    camera: Tensor
    point: Tensor
    pixels: Tensor

    def moved(self, poses_cw: Tensor, points: Tensor) -> PointProblem:
        """The same measurements with other poses ``(C, 7)`` and points ``(K, 3)``."""
        return replace(self, poses_cw=poses_cw, points=points)


def read_bal(path: Path | str) -> PointProblem:
    """Read a problem, plain or bz2-compressed.

    Args:
        path: text file in either format.

    Returns:
        The problem with z forward and y down.

    Raises:
        DvoError: missing file, words that are not numbers, a length that fits neither format, or indices out of range.
    """
    path = Path(path)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give a bundle adjustment problem in BAL format")
    try:
        text = (bz2.decompress(path.read_bytes()) if path.suffix == ".bz2" else path.read_bytes()).decode("ascii")
        lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
        numbers = np.array(" ".join(lines).split(), dtype=np.float64)
    except (ValueError, OSError) as error:  # OSError: not bz2 data
        raise DvoError(f"not a text file of numbers ({error})", file=path, remedy="give a BAL problem") from error
    if len(numbers) < 3 or not np.isfinite(numbers).all():
        raise DvoError("too short, or numbers that are not finite", file=path, remedy="give a BAL problem")
    cameras, points, observations = (int(x) for x in numbers[:3])
    body = numbers[3:]
    if len(body) == 4 * observations + 9 * cameras + 3 * points:
        shared, body = None, body
    elif len(body) == 4 + 4 * observations + 6 * cameras + 3 * points:
        shared, body = body[:4], body[4:]
    else:
        raise DvoError(
            f"{len(body)} numbers do not make {cameras} cameras, {points} points and {observations} observations",
            file=path,
            remedy="check that the file is complete",
        )
    seen = body[: 4 * observations].reshape(-1, 4)
    camera, point, pixels = seen[:, 0].astype(np.int64), seen[:, 1].astype(np.int64), seen[:, 2:]
    for index, count, field in ((camera, cameras, "camera index"), (point, points, "point index")):
        if len(index) and not (index.min() >= 0 and index.max() < count):
            raise DvoError(f"outside 0..{count - 1}", file=path, field=field, remedy="check that the file is complete")
    rest = body[4 * observations :]
    parameters = rest[: len(rest) - 3 * points].reshape(cameras, -1)
    poses, intrinsics, radial = _bal_cameras(parameters) if shared is None else _shared_cameras(parameters, shared)
    if shared is None:
        pixels = pixels * [1, -1]
    world = rest[len(rest) - 3 * points :].reshape(-1, 3)
    made = (torch.from_numpy(np.ascontiguousarray(x)) for x in (world, camera, point, pixels))
    return PointProblem(poses, intrinsics, radial, *made)


def _bal_cameras(parameters: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Poses, intrinsics, distortion. A rotation by pi about x maps -z forward, y up to z forward, y down."""
    p = torch.from_numpy(np.ascontiguousarray(parameters))
    half_turn = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    q = so3.multiply(half_turn, so3.exp(p[:, :3]))
    t = p[:, 3:6] * torch.tensor([1.0, -1, -1], dtype=torch.float64)
    zero = torch.zeros_like(p[:, 6])
    return torch.cat((t, q), -1), torch.stack((p[:, 6], p[:, 6], zero, zero), -1), p[:, 7:9].clone()


def _shared_cameras(parameters: np.ndarray, shared: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    p = torch.from_numpy(np.ascontiguousarray(parameters))
    intrinsics = torch.from_numpy(shared.copy()).expand(len(p), 4)
    return torch.cat((p[:, :3], so3.exp(p[:, 3:])), -1), intrinsics.clone(), torch.zeros(len(p), 2, dtype=p.dtype)
