"""Readers of COLMAP's files by their documented layout alone."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np


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
