"""Reconstructions for the exports, and readers of COLMAP's files by their documented layout alone."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st

from dvo.export.reconstruction import Reconstruction
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices
from dvo.graph.archive import ArchiveConfig, encode_jpeg
from dvo.graph.keyframe_graph import KeyframeGraph
from tests.archived_walk import ROWS, M, archived_walk

SIDE = 4 * ROWS  # of the images of a walk, pixels


def image(number):
    """``(SIDE, SIDE, 3)`` uint8 of one colour, another for every number."""
    return np.full((SIDE, SIDE, 3), (10 + 4 * (number % 50), 200, 90), np.uint8)


def walk(frames: int = 12, wrong: float = 0.0, dropped: tuple[int, ...] = (), **config) -> KeyframeGraph:
    """Graph of a walk that is archived with images and true poses.

    Args:
        frames, wrong, dropped: of :func:`tests.archived_walk.archived_walk`.
        config: of the archive.
    """
    archive = ArchiveConfig(**config)
    graph, truth = archived_walk(frames, wrong, dropped, archive, archived=False)
    for frame in graph.window.frames:
        frame.image = image(frame.identifier)
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


@dataclass
class Image:
    """Image of a model: ``qvec`` is w x y z; ``points`` are rows x, y, number of the point."""

    qvec: np.ndarray
    tvec: np.ndarray
    camera: int
    name: str
    points: np.ndarray

    def project(self, point, parameters):
        """Pixel of a world point, by COLMAP's convention."""
        w, x, y, z = self.qvec
        v = np.array([x, y, z])
        seen = point + 2 * np.cross(v, np.cross(v, point) + w * point) + self.tvec
        fx, fy, cx, cy = parameters
        return np.array([fx * seen[0] / seen[2] + cx, fy * seen[1] / seen[2] + cy])


@dataclass
class Model:
    """Sparse model: cameras ``(name of the model, width, height, parameters)``, images, and points ``(xyz, rgb, error,
    track)`` by their numbers."""

    cameras: dict
    images: dict
    points: dict


class _Bytes:
    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, form: str):
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        found, self.at = self.data[self.at : end].decode(), end + 1
        return found

    def end(self) -> None:
        assert self.at == len(self.data)


def read_binary(folder: Path) -> Model:
    """Model of cameras.bin, images.bin and points3D.bin."""
    cameras, images, points = {}, {}, {}
    file = _Bytes(folder / "cameras.bin")
    for _ in range(*file.take("Q")):
        number, model, width, height = file.take("iiQQ")
        assert model == 1
        cameras[number] = ("PINHOLE", width, height, np.array(file.take("4d")))
    file.end()
    file = _Bytes(folder / "images.bin")
    for _ in range(*file.take("Q")):
        (number,) = file.take("i")
        pose, (camera,), name = np.array(file.take("7d")), file.take("i"), file.text()
        rows = [file.take("ddq") for _ in range(*file.take("Q"))]
        images[number] = Image(pose[:4], pose[4:], camera, name, np.array(rows).reshape(-1, 3))
    file.end()
    file = _Bytes(folder / "points3D.bin")
    for _ in range(*file.take("Q")):
        (number,) = file.take("Q")
        xyz, rgb, (error,) = np.array(file.take("3d")), file.take("3B"), file.take("d")
        points[number] = (xyz, rgb, error, [file.take("ii") for _ in range(*file.take("Q"))])
    file.end()
    return Model(cameras, images, points)


def read_text(folder: Path) -> Model:
    """Model of cameras.txt, images.txt and points3D.txt."""

    def lines(name):
        text = (folder / name).read_text().split("\n")
        assert text.pop() == ""
        return [line.split() for line in text if not line.startswith("#")]

    cameras, images, points = {}, {}, {}
    for number, model, width, height, *values in lines("cameras.txt"):
        cameras[int(number)] = (model, int(width), int(height), np.array(values, float))
    rows = lines("images.txt")
    for head, body in zip(rows[::2], rows[1::2], strict=True):
        pose = np.array(head[1:8], float)
        images[int(head[0])] = Image(pose[:4], pose[4:], int(head[8]), head[9], np.array(body, float).reshape(-1, 3))
    for number, *row in lines("points3D.txt"):
        track = [int(value) for value in row[7:]]
        colors = tuple(int(value) for value in row[3:6])
        points[int(number)] = (np.array(row[:3], float), colors, float(row[6]),
                               list(zip(track[::2], track[1::2], strict=True)))  # fmt: skip
    return Model(cameras, images, points)
