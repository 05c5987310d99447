"""Reconstructions for the exports: an archived walk with images, and single views of a point."""

import numpy as np
import torch
from hypothesis import strategies as st

from dvo.export.reconstruction import Reconstruction
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices
from dvo.map.archive import ArchiveConfig, encode_jpeg
from dvo.map.keyframe_graph import KeyframeGraph
from tests.support.archived_walk import ROWS, M, archived_walk

SIDE = 4 * ROWS  # of the images of a walk, pixels


def image(number):
    """``(SIDE, SIDE, 3)`` uint8 of one colour, another for every number."""
    return np.full((SIDE, SIDE, 3), (10 + 4 * (number % 50), 200, 90), np.uint8)


def walk(frames: int = 12, wrong: float = 0.0, dropped: tuple[int, ...] = (), masks=None, **config) -> KeyframeGraph:
    """Graph of a walk that is archived with images and true poses.

    Args:
        frames, wrong, dropped: of :func:`tests.support.archived_walk.archived_walk`.
        masks: number of a frame to ``(SIDE, SIDE)`` bool.
        config: of the archive.
    """
    archive = ArchiveConfig(**config)
    graph, truth = archived_walk(frames, wrong, dropped, archive, archived=False)
    for frame in graph.window.frames:
        frame.image, frame.mask = image(frame.identifier), (masks or {}).get(frame.identifier)
        frame.colors = torch.arange(3 * M, dtype=torch.uint8).reshape(M, 3) + frame.identifier
    while len(graph.window):
        graph.archive_oldest()
    for identifier, pose_wc in enumerate(truth.poses_wc):
        graph.correct(identifier, se3.inverse(torch.from_numpy(pose_wc)).numpy())
    return graph


def one_view(T_cw, camera: Camera, pixel, depth: float) -> tuple[Reconstruction, np.ndarray]:
    """Reconstruction of one image and one point, and the position of the point in the world.

    Args:
        T_cw: ``(4, 4)``.
        camera: of the image.
        pixel: ``(2,)`` at which the point is seen, pixel centres at integers.
        depth: of the point along the optical axis.
    """
    seen = np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0]) * depth
    point = T_cw[:3, :3].T @ (seen - T_cw[:3, 3])
    zero = np.zeros(1, dtype=np.int64)
    jpeg = encode_jpeg(np.zeros((camera.height, camera.width, 3), np.uint8), 90).tobytes()
    found = Reconstruction(
        (camera,), zero, zero, np.zeros(1), T_cw[None], (jpeg,), point[None], np.array([[1, 2, 3]], np.uint8),
        np.zeros(1), zero, zero, np.array([pixel], dtype=np.float64), np.zeros(1),
    )  # fmt: skip
    return found, point


@st.composite
def views(draw):
    """Pose of a camera, the camera, and a pixel with a depth."""
    quaternion = np.array([draw(st.floats(-1, 1)) for _ in range(4)])
    quaternion = quaternion if np.linalg.norm(quaternion) > 0.1 else np.array([0.0, 0, 0, 1])
    T_cw = pose_matrices(np.concatenate([[10 * draw(st.floats(-1, 1)) for _ in range(3)], quaternion]))
    camera = Camera(draw(st.floats(40, 90)), draw(st.floats(40, 90)), draw(st.floats(20, 40)), 22.0, 64, 48)
    return T_cw, camera, np.array([draw(st.floats(0, 63)), draw(st.floats(0, 47))]), draw(st.floats(0.5, 20))
