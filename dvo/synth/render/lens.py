"""Images through a lens with distortion: exact depth, surfaces and texture coordinates, resampled colours.

A pinhole image, the plate, covers the whole field of view of the lens. If the four plate pixels around the position of
a lens pixel show one surface, that surface's linear functions are evaluated at the position itself; the other pixels,
those along outlines, are traced as rays. Colours are read from a plate of finer grid, several samples to a pixel. The
distortion models are those of :mod:`dvo.geometry.undistort`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera, DistortionModel
from dvo.geometry.undistort import distort, in_range, undistort
from dvo.synth.meshes.mesh import MeshScene
from dvo.synth.render.quality import STANDARD, Quality
from dvo.synth.render.renderer import Rendering, cast, render, trace, view_scene
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
WIDEST = 4.0  # times the image's edge; a larger plate would be of a lens that looks nearly sideways
FAR_OFF = -1e4  # pixels
MARGIN = 2  # pixels of plate around what is needed


def undistorted_pixels(pixels: Array, camera: Camera) -> Array:
    """Undistorted pixels.

    Args:
        pixels: ``(..., 2)`` of the camera with distortion.
        camera: with its distortion.

    Returns:
        ``(..., 2)`` pixels of the pinhole camera with the same intrinsics; NaN outside the range of the lens model.
    """
    if not camera.needs_undistortion:
        return pixels
    focal, centre = camera.intrinsics[:2], camera.intrinsics[2:]
    return undistort((pixels - centre) / focal, camera) * focal + centre


def distorted_pixels(pixels: Array, camera: Camera) -> Array:
    """Distorted pixels, the inverse of :func:`undistorted_pixels`.

    Args:
        pixels: ``(..., 2)`` of the pinhole camera with the same intrinsics.
        camera: with its distortion.

    Returns:
        ``(..., 2)`` pixels of the camera with distortion; far outside the image beyond the range of the lens model.
    """
    if not camera.needs_undistortion:
        return pixels
    focal, centre = camera.intrinsics[:2], camera.intrinsics[2:]
    ideal = (pixels - centre) / focal
    places = distort(ideal, camera) * focal + centre
    return np.where(in_range(ideal, camera)[..., None], places, FAR_OFF)


@dataclass(frozen=True)
class Plate:
    """Pinhole image that covers a lens image.

    Attributes:
        intrinsics: ``(4,)`` fx fy cx cy of the plate.
        size: its height and width, pixels.
        places: ``(H, W, 2)`` float64 positions in the plate of the pixel centres of the lens image.
        fine: ``(1, H m, W m, 2)`` float32 positions of m x m samples of each pixel in the plate of m times finer grid,
            as ``grid_sample`` takes them.
    """

    intrinsics: Array
    size: tuple[int, int]
    places: Array
    fine: Tensor


@lru_cache(maxsize=4)
def plate_of(camera: Camera, parts: int) -> Plate:
    """Plate of a camera.

    Args:
        camera: with its distortion.
        parts: samples m per pixel edge.

    Returns:
        The plate, kept for the next call.

    Raises:
        DvoError: the lens model has no ray for a pixel, or the plate would be huge.
    """
    y, x = np.mgrid[: camera.height, : camera.width].astype(float)
    places = undistorted_pixels(np.stack([x, y], -1), camera)
    steps = (np.arange(parts * max(camera.height, camera.width)) + 0.5) / parts - 0.5
    fine_y, fine_x = np.meshgrid(steps[: parts * camera.height], steps[: parts * camera.width], indexing="ij")
    fine = undistorted_pixels(np.stack([fine_x, fine_y], -1), camera)
    reach = np.ptp(fine.reshape(-1, 2), axis=0)
    if not np.isfinite(fine).all() or (reach > WIDEST * np.array([camera.width, camera.height])).any():
        raise DvoError(
            f"these {camera.model} coefficients fold the {camera.width}x{camera.height} picture over itself or see "
            "nearly sideways",
            field="camera",
            remedy="give weaker coefficients or a longer focal length",
        )
    low = np.floor(fine.reshape(-1, 2).min(0)) - MARGIN
    width, height = (int(n) for n in np.ceil(fine.reshape(-1, 2).max(0)) + MARGIN + 1 - low)
    # A coarse pixel c is the fine pixels around m c + (m - 1) / 2; grid_sample counts the edges of the plate as -1, 1.
    grid = 2 * (fine - low + 0.5) / [width, height] - 1
    intrinsics = camera.intrinsics - np.array([0, 0, *low])
    return Plate(intrinsics, (height, width), places - low, torch.from_numpy(grid.astype(np.float32))[None])


def random_lens(rng: np.random.Generator, camera: Camera, model: DistortionModel) -> Camera:
    """Draw distortion coefficients such that the whole image stays in the range of the model.

    ``radtan``: barrel or pincushion, at the corners up to 13 % of their distance from the centre, hardly decentred.
    ``fisheye``: nearly equidistant; its corners are up to 65 degrees off axis, for which the focal length may grow.

    Args:
        rng: draws them.
        camera: pinhole.
        model: "none" returns the camera as it is.

    Returns:
        The camera with its distortion.
    """
    if model == "none":
        return camera
    ends = np.array([[0, 0], [camera.width - 1, 0], [0, camera.height - 1], [camera.width - 1, camera.height - 1]])
    corner = np.linalg.norm((ends - camera.intrinsics[2:]) / camera.intrinsics[:2], axis=-1).max()
    if model == "radtan":
        # Of r (1 + k1 r^2) = R there is a solution while -k1 R^2 < 4/27 = 0.148.
        radial = rng.uniform(-0.13, 0.06) / corner**2
        tangential = np.clip(rng.normal(0, 3e-4, 2), -1e-3, 1e-3) / max(corner, 1)
        return replace(camera, model=model, coefficients=(float(radial), 0.0, *(float(p) for p in tangential)))
    k1, k2 = np.clip(rng.normal(0, [0.01, 0.003]), -0.02, 0.02)
    longer = max(1.0, corner / np.deg2rad(65))
    bending = replace(camera, fx=camera.fx * longer, fy=camera.fy * longer)
    return replace(bending, model=model, coefficients=(float(k1), float(k2), 0.0, 0.0))


def render_lens(
    scene: Scene | Stage, poses_wc: Array, camera: Camera, *, times: Array | None = None, quality: Quality = STANDARD,
    device: torch.device | str = "cpu", coordinates: bool = True,
) -> Rendering:  # fmt: skip
    """Render N frames of a camera with distortion.

    Args:
        scene: static, or with moving bodies.
        poses_wc: ``(N, 7)`` camera to world.
        camera: with its distortion.
        times, quality, device, coordinates: as for :func:`dvo.synth.render.renderer.render`; at least 2 x 2 samples are
            taken of each pixel for the colours.

    Returns:
        As :func:`dvo.synth.render.renderer.render`.

    Raises:
        DvoError: a mesh (its triangles are too small for this), or a lens whose field of view no plane can hold.
    """
    if isinstance(scene, MeshScene):
        raise DvoError("meshes are not rendered through a lens", field="camera", remedy="give a camera without model")
    parts = max(2, quality.supersample)  # one sample per pixel would alias where the lens compresses
    plate = plate_of(camera, parts)
    height, width = plate.size
    scale = np.array([parts, parts, parts, parts])
    fine_k = plate.intrinsics * scale + [0, 0, 0.5 * parts - 0.5, 0.5 * parts - 0.5]
    images = torch.empty(len(poses_wc), 3, camera.height, camera.width, device=device)
    exact: list[Tensor] = []
    depth = torch.empty(len(poses_wc), camera.height, camera.width, device=device)
    surface = torch.empty(depth.shape, dtype=torch.int64, device=device)
    for n in range(len(poses_wc)):
        one = None if times is None else np.asarray(times)[n : n + 1]
        pose = np.asarray(poses_wc, float)[n : n + 1]
        sharp = render(
            scene, pose, fine_k, height * parts, width * parts, quality=Quality(taps=quality.taps), device=device,
            coordinates=False, times=one,
        )  # fmt: skip
        read = torch.nn.functional.grid_sample(sharp.images, plate.fine.to(device), align_corners=False)
        images[n] = torch.nn.functional.avg_pool2d(read, parts)[0]
        z, name, uv = _exact(scene, pose, plate, one, device)
        depth[n], surface[n] = torch.from_numpy(z).to(depth), torch.from_numpy(name).to(surface)
        exact.append(torch.from_numpy(uv).to(depth))
    uvs = torch.stack(exact) if coordinates else torch.zeros(len(poses_wc), 0, 0, 2, device=device)
    return Rendering(images, depth, surface, uvs)


def _exact(
    scene: Scene | Stage, pose: Array, plate: Plate, time: Array | None, device: torch.device | str
) -> tuple[Array, Array, Array]:
    """Depth ``(H, W)``, surface ``(H, W)`` and uv ``(H, W, 2)`` at the positions of one frame, float64."""
    _, view = view_scene(scene, pose, plate.intrinsics[None], plate.size, time)
    _, local, _ = cast(view, *plate.size, device)
    rows = local[0].cpu().numpy()
    shape = plate.places.shape[:2]
    places = plate.places.reshape(-1, 2)
    x, y = np.floor(places).astype(int).T
    around = np.stack([rows[y, x], rows[y, x + 1], rows[y + 1, x], rows[y + 1, x + 1]])
    agreed = (around == around[0]).all(0) & (around[0] >= 0)
    homogeneous = np.concatenate([places, np.ones((len(places), 1))], 1)
    depth, surface, uv = np.zeros(len(places)), np.full(len(places), -1), np.zeros((len(places), 2))
    basis = view.basis[0, around[0, agreed]] @ homogeneous[agreed, :, None]  # (M, 3, 1) u/Z, v/Z, 1/Z
    depth[agreed] = 1 / basis[:, 2, 0]
    uv[agreed] = basis[:, :2, 0] * depth[agreed, None]
    surface[agreed] = view.index[around[0, agreed]]
    doubt = np.flatnonzero(~agreed)
    for begin in range(0, len(doubt), 2048):
        part = doubt[begin : begin + 2048]
        traced = trace(scene, pose, plate.intrinsics, places[None, part], time, plate.size)
        depth[part], surface[part], uv[part] = (values[0] for values in traced)
    return depth.reshape(shape), surface.reshape(shape), uv.reshape(*shape, 2)
