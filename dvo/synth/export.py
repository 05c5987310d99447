"""Export of sequences in the layouts of TUM RGB-D, TartanAir and EuRoC, and of scenes as triangles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.data.files.output import new_folder, spelled_in_text
from dvo.data.inertial import NOISE_PRESETS, ImuNoise
from dvo.data.trajectory import Trajectory, write_tum
from dvo.geometry.camera import Camera
from dvo.geometry.poses import NED_FROM_CAMERA, invert_rodrigues, pose_matrices, poses_from_matrices, split
from dvo.synth import salts
from dvo.synth.euroc_tables import check_lens, nanoseconds, write_tables
from dvo.synth.meshes.mesh import MeshScene
from dvo.synth.motion.walks import long_path
from dvo.synth.scenes.scene import Scene
from dvo.synth.sensors.sensor import random_intrinsics
from dvo.synth.sequence import SyntheticSequence
from dvo.synth.specs import MotionSpec, SequenceFormat

Array = np.ndarray
Layout = Literal["tum", "tartanair", "euroc"]
TUM_FACTOR = 5000  # units of a metre in TUM's 16-bit depth
# TartanAir's codes of flow that has no counterpart.
OCCLUDED, OUT_OF_VIEW = 1, 100


def scene_triangles(scene: Scene) -> tuple[Array, Array, Array]:
    """Triangles of a scene.

    Args:
        scene: flat surfaces.

    Returns:
        Vertices ``(V, 3)``, faces ``(F, 3)`` counter-clockwise from the front, the surface of each face ``(F,)``.
    """
    count = len(scene)
    faces = np.arange(count)[:, None] * 4 + np.array([[0, 1, 2, 0, 2, 3]])
    is_triangle = (scene.corners[:, 2] == scene.corners[:, 3]).all(1)
    keep = np.stack([np.ones(count, bool), ~is_triangle], 1).ravel()
    owner = np.repeat(np.arange(count), 2)
    return scene.corners.reshape(-1, 3), faces.reshape(-1, 3)[keep], owner[keep]


def mesh_sequence(
    scene: MeshScene, seed: int, form: SequenceFormat | None = None, motion: MotionSpec | None = None, *,
    name: str = "mesh", device: torch.device | str = "cpu",
) -> SyntheticSequence:  # fmt: skip
    """Sequence of clean frames along a path around a mesh (an orbit) or through it (a hand-held walk).

    Args:
        scene: the mesh.
        seed: draws path and intrinsics; same seed, same bytes.
        form: length, size and rate; 100 frames of 320x240 at 30 Hz if None.
        motion: kind of path (one that suits the mesh if its ``kind`` is None), speed and shake.
        name: of the sequence.
        device: where to render.

    Returns:
        The sequence, in units of the mesh.

    Raises:
        DvoError: an unknown kind of path, or no room for a camera.
    """
    form, motion = form or SequenceFormat(frames=100), motion or MotionSpec()
    rng = np.random.default_rng([seed, salts.MESH_SEQUENCE])
    kind = motion.kind or ("handheld" if scene.space.inside else "orbit")
    world: Any = scene  # a MeshScene has the bounds, clearance and depth of a Scene
    path_seed = int(rng.integers(2**31))
    path = long_path(world, path_seed, kind, form.duration, speed=motion.speed, shake=motion.shake)
    fx, fy, cx, cy = random_intrinsics(rng, form.height, form.width).tolist()
    camera = Camera(fx, fy, cx, cy, form.width, form.height)
    times = np.arange(form.frames) / form.fps
    truth = Trajectory(times, path.poses_wc(times))
    return SyntheticSequence(f"{name}-{kind}-{seed}", camera, truth, world, path, None, seed, form.supersample, device)


def export_sequence(
    sequence: SyntheticSequence,
    out: Path | str,
    layout: Layout,
    *,
    on_frame: Callable[[int], None] | None = None,
    noise: ImuNoise | None = NOISE_PRESETS["euroc"],
) -> list[str]:
    """Write a sequence.

    ``tum``: ``rgb/``, ``depth/`` (16 bit, 5000 to a metre, 0 for none or beyond 13.1 m), ``rgb.txt``, ``depth.txt``,
    ``groundtruth.txt``. ``tartanair``: ``image_left/``, ``depth_left/*.npy`` (metres, float32, 0 for none), ``flow/``
    with masks (0 valid, 1 occluded, 100 out of view), ``pose_left.txt`` (camera x forward, y right, z down; the world's
    z axis points up, unlike TartanAir's), ``imu/cam_time.txt``. Both: ``calib.txt`` with fx fy cx cy; of a lens with
    distortion (``tum`` only) also its coefficients, of a fisheye or a rolling shutter ``calib.yaml`` instead.
    ``euroc``: ``mav0`` with ``cam0``, ``imu0`` (200 samples a second in the camera's axes) and
    ``state_groundtruth_estimate0``, without depth.

    Args:
        sequence: rendered frame by frame while it is written.
        out: folder, new or empty.
        layout: ``tum``, ``tartanair`` or ``euroc``.
        on_frame: called with the number of frames written so far.
        noise: of the inertial samples of ``euroc``; None for exact ones.

    Returns:
        Notes on content that the layout cannot hold.

    Raises:
        DvoError: an unknown layout, or a folder that is not empty or cannot be written.
    """
    if layout not in ("tum", "tartanair", "euroc"):
        raise DvoError(f"no layout {layout!r}", field="layout", remedy="choose tum, tartanair or euroc")
    if layout == "euroc":
        check_lens(sequence.camera)
    if layout == "tartanair" and sequence.camera.needs_undistortion:
        raise DvoError("TartanAir's layout has no lens distortion", field="layout", remedy="choose tum")
    out = Path(out)
    try:
        with new_folder(out) as part:
            frames = _frames(sequence, on_frame)
            if layout == "euroc":
                notes = _write_euroc(frames, sequence, part, noise)
            else:
                write_calibration(sequence.camera, part)
                notes = (_write_tum if layout == "tum" else _write_tartanair)(frames, sequence, part)
    except OSError as error:
        raise DvoError(f"cannot be written ({error.strerror})", file=out, remedy="name a folder elsewhere") from error
    return [*sequence.warnings, *notes]


def write_calibration(camera: Camera, out: Path, baseline: float = 0.0) -> None:
    """Write ``calib.txt``, or ``calib.yaml`` for what only that can state: a fisheye or another wide model, more than
    five coefficients, a rolling shutter, a stereo pair.

    Args:
        camera: of the images.
        out: the folder.
        baseline: metres to the right camera of a rectified pair with the same intrinsics, 0 without one.

    Raises:
        OSError: it cannot be written.
    """
    of_text = camera.model in ("none", "radtan") and len(camera.coefficients) <= 5
    if not of_text or camera.readout > 0 or baseline > 0:
        rows = {name: f"{value:.9f}" for name, value in zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=True)}
        rows |= {"width": str(camera.width), "height": str(camera.height), "model": camera.model}
        rows |= {"coefficients": str(list(camera.coefficients)), "readout": f"{camera.readout:.9f}"}
        rows |= {"baseline": f"{baseline:.9f}"} if baseline > 0 else {}
        text = "\n".join(f"{name}: {value}" for name, value in rows.items())
        (out / "calib.yaml").write_text(text + "\n", encoding="utf-8")
        return
    numbers = [*camera.intrinsics, *camera.coefficients]
    names = "fx fy cx cy, pixels" + (" (then k1 k2 p1 p2)" if camera.coefficients else "")
    line = " ".join(f"{value:.9f}" for value in numbers)
    (out / "calib.txt").write_text(f"# {names}\n{line}\n", encoding="utf-8")


def _frames(sequence: SyntheticSequence, on_frame: Callable[[int], None] | None) -> Iterator[tuple[int, Array, Array]]:
    """Index, image ``(H, W, 3)`` uint8, depth ``(H, W)`` float32."""
    for index in range(len(sequence)):
        clean = sequence.rendering(index)
        if sequence.sensor is None:
            image = (clean.images[0] * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
        else:
            image = sequence.frame(index).image
        yield index, image, clean.depth[0].cpu().numpy()
        if on_frame is not None:
            on_frame(index + 1)


def _write_picture(path: Path, picture: Array) -> None:
    picture = picture[..., ::-1] if picture.ndim == 3 else picture
    with spelled_in_text(path) as name:
        is_written = cv2.imwrite(name, picture)
    if not is_written:
        raise DvoError("cannot be written", file=path, remedy="name a folder elsewhere")


def write_depth(folder: Path, stamp: str, depth: Array) -> int:
    """Write a depth image in the layout of TUM RGB-D: ``depth/STAMP.png``, 16 bit, 5000 to a metre, 0 for none.

    Args:
        folder: of the sequence; ``depth`` is made in it if need be.
        stamp: name of the image, its time in seconds.
        depth: ``(H, W)`` metres, 0 for none.

    Returns:
        Number of pixels that are too far away, 13.1 m or more, and have none.

    Raises:
        DvoError: the file cannot be written.
    """
    (folder / "depth").mkdir(exist_ok=True)
    units = np.rint(depth.astype(float) * TUM_FACTOR)
    beyond = units > 65535
    _write_picture(folder / "depth" / f"{stamp}.png", np.where(beyond, 0, units).astype(np.uint16))
    return int(beyond.sum())


def _write_tum(frames: Iterator[tuple[int, Array, Array]], sequence: SyntheticSequence, out: Path) -> list[str]:
    (out / "rgb").mkdir()
    (out / "depth").mkdir()
    times = sequence.groundtruth.timestamps.round(6)  # as in the file names
    lists: dict[str, list[str]] = {"rgb": ["# timestamp filename"], "depth": ["# timestamp filename"]}
    beyond = total = 0
    for index, image, depth in frames:
        stamp = f"{times[index]:.6f}"
        beyond += write_depth(out, stamp, depth)
        total += depth.size
        _write_picture(out / "rgb" / f"{stamp}.png", image)
        for kind, rows in lists.items():
            rows.append(f"{stamp} {kind}/{stamp}.png")
    for kind, rows in lists.items():
        (out / f"{kind}.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    write_tum(out / "groundtruth.txt", Trajectory(times, sequence.groundtruth.poses_wc))
    far = 65535 / TUM_FACTOR
    return [f"{beyond / total:.1%} of the depths exceed {far:.1f} m and are written as 0 (none)"] if beyond else []


def _write_tartanair(frames: Iterator[tuple[int, Array, Array]], sequence: SyntheticSequence, out: Path) -> list[str]:
    for folder in ("image_left", "depth_left", "flow", "imu"):
        (out / folder).mkdir()
    poses = sequence.groundtruth.poses_wc
    matrices = pose_matrices(poses)
    matrices[..., :3, :3] = matrices[..., :3, :3] @ NED_FROM_CAMERA.T
    np.savetxt(out / "pose_left.txt", poses_from_matrices(matrices), fmt="%.9f")
    np.savetxt(out / "imu" / "cam_time.txt", sequence.groundtruth.timestamps, fmt="%.9f")
    before: Array | None = None
    for index, image, depth in frames:
        _write_picture(out / "image_left" / f"{index:06d}_left.png", image)
        np.save(out / "depth_left" / f"{index:06d}_left_depth.npy", depth)
        if before is not None:
            flow, mask = static_flow(before, depth, poses[index - 1 : index + 1], sequence.camera.intrinsics)
            name = f"{index - 1:06d}_{index:06d}"
            np.save(out / "flow" / f"{name}_flow.npy", flow)
            np.save(out / "flow" / f"{name}_mask.npy", mask)
        before = depth
    return []


def _write_euroc(
    frames: Iterator[tuple[int, Array, Array]], sequence: SyntheticSequence, out: Path, noise: ImuNoise | None
) -> list[str]:
    (out / "mav0" / "cam0" / "data").mkdir(parents=True)
    stamps = nanoseconds(sequence.groundtruth.timestamps)
    for index, image, _ in frames:
        _write_picture(out / "mav0" / "cam0" / "data" / f"{stamps[index]}.png", image)
    write_tables(sequence, noise, out / "mav0")
    return []


def static_flow(first: Array, second: Array, poses_wc: Array, intrinsics: Any) -> tuple[Array, Array]:
    """Flow of a static scene from one frame to another, from depth and poses.

    Args:
        first, second: ``(H, W)`` depth, 0 for none (a background at infinity).
        poses_wc: ``(2, 7)``, in units of the depth.
        intrinsics: fx fy cx cy, pixels.

    Returns:
        ``(H, W, 2)`` float32 pixels; ``(H, W)`` uint8 mask: 0 valid, 1 occluded, 100 out of view.
    """
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    height, width = first.shape
    y, x = np.mgrid[:height, :width]
    (r0, t0), (r1, t1) = split(poses_wc[0]), split(invert_rodrigues(poses_wc[1]))
    ray = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones(first.shape)], -1)
    near = first[..., None].astype(float) > 0
    points = np.where(near, (ray * first[..., None]) @ r0.T + t0, ray @ r0.T)
    local = np.where(near, points @ r1.T + t1, points @ r1.T)
    z = local[..., 2]
    safe = np.where(z > 1e-6, z, np.nan)
    u, v = fx * local[..., 0] / safe + cx, fy * local[..., 1] / safe + cy
    there = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    column, row = (np.where(there, at, 0).round().astype(int) for at in (u, v))
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    # Occluded where everything visible around the point is nearer (it lies between pixels).
    seen = np.where(second > 0, second, np.inf)
    around = cv2.dilate(np.where(np.isfinite(seen), seen, 1e9).astype(np.float32), np.ones((3, 3)))[row, column]
    hidden = there & (around < 0.99 * np.where(near[..., 0], z, 1e8))
    mask = np.where(~there, OUT_OF_VIEW, np.where(hidden, OCCLUDED, 0)).astype(np.uint8)
    return np.nan_to_num(np.stack([u - x, v - y], -1)).astype(np.float32), mask
