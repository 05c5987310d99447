"""Nerfstudio's data format: transforms.json, images and a point cloud
(https://docs.nerf.studio/quickstart/data_conventions.html).

The camera has x right, y up and looks along -z (OpenGL), in place of dvo's x right, y down, z forward. The world has z
up, so the world of the first keyframe is turned by :data:`APPLIED_TRANSFORM`, poses and points alike. Rays of pixel
``(0, 0)`` go through ``(0.5, 0.5)``, so 0.5 is added to the principal point, as for COLMAP.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.calibration.calibration import FOUND
from dvo.export.colmap import mask_file, write_images
from dvo.export.reconstruction import CORNER, Reconstruction
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import SparseMap
from dvo.session.files import write_ply

APPLIED_TRANSFORM = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""``(3, 4)`` from the world of the keyframes (y down) to that of the files (z up): ``(x, y, z)`` to ``(x, z, -y)``."""

_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])  # its own inverse
POINTS = "sparse_pc.ply"


def write_nerfstudio(reconstruction: Reconstruction, folder: Path) -> None:
    """Write transforms.json, ``images/``, ``masks/``, the points as sparse_pc.ply, and times.txt.

    Args:
        reconstruction: of one world.
        folder: an empty folder.

    Raises:
        OSError: a file cannot be written.
    """
    r = reconstruction
    write_images(r, folder)
    points = r.points @ APPLIED_TRANSFORM[:, :3].T + APPLIED_TRANSFORM[:, 3]
    write_ply(folder / POINTS, SparseMap(points.astype(np.float32), r.colors))
    single = len(r.cameras) == 1
    frames = []
    rows = zip(r.names, r.timestamps.tolist(), camera_matrices(r.T_cw).tolist(), r.camera_of.tolist(), strict=True)
    for name, time, matrix, camera in rows:
        own = {} if single else _intrinsics(r.cameras[camera])
        own |= {"mask_path": mask_file(name)} if r.masks else {}
        frames.append({"file_path": f"images/{name}", "timestamp": time, **own, "transform_matrix": matrix})
    values = {
        "camera_model": "OPENCV",
        **({FOUND: True} if r.was_found else {}),
        **(_intrinsics(r.cameras[0]) if single else {}),
        "applied_transform": APPLIED_TRANSFORM.tolist(),
        "ply_file_path": POINTS,
        "frames": frames,
    }
    text = json.dumps(values, indent=2, allow_nan=False)
    (folder / "transforms.json").write_text(text + "\n", encoding="utf-8", newline="\n")


def camera_matrices(T_cw: np.ndarray) -> np.ndarray:
    """Transform matrices of the format.

    Args:
        T_cw: ``(N, 4, 4)`` world to camera, camera x right, y down, z forward.

    Returns:
        ``(N, 4, 4)`` camera to world, camera x right, y up, z backward, world turned by :data:`APPLIED_TRANSFORM`.
    """
    turned = np.vstack([APPLIED_TRANSFORM, [0, 0, 0, 1]])
    return turned @ np.linalg.inv(T_cw) @ _GL_FROM_CV


def _intrinsics(camera: Camera) -> dict[str, Any]:
    sides = {"w": camera.width, "h": camera.height}
    focal = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + CORNER, "cy": camera.cy + CORNER}
    return {**focal, **sides, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
