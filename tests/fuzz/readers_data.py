"""Readers of data sets: every layout, opened and read through ``dvo.open``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from dvo.data.open import open_source
from tests.fuzz.target import Target, chance, check_frames, check_trajectory, require

WIDTH, HEIGHT, COUNT = 64, 48, 4
K = "50 51 31.5 23.5"
MODULES = ("cv2", "yaml", "dvo.data.open", *(f"dvo.data.readers.{name}" for name in (
    "euroc", "folder", "icl_nuim", "kitti", "sequence", "tartanair", "tum", "video")))  # fmt: skip


def picture(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """``(H, W, 3)`` uint8 image of blobs that move to the right.

    Args:
        index: of the frame.
        width, height: pixels.
    """
    noise = np.random.default_rng(7).integers(0, 256, (height // 4, width // 4 + 16, 3), dtype=np.uint8)
    large = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    return large[:, 3 * index : 3 * index + width]


def images(folder: Path, names: list[str]) -> None:
    """Write images.

    Args:
        folder: made if need be.
        names: of the files; the suffix selects the format.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        image = picture(index)
        cv2.imwrite(str(folder / name), image[..., 1] if name.endswith(".pgm") else image)


def depths(folder: Path, names: list[str]) -> None:
    """Write depth images of 16 bit, or arrays of metres, as the suffixes say.

    Args:
        folder: made if need be.
        names: of the files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        metres = np.linspace(1, 3, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
        if name.endswith(".npy"):
            np.save(folder / name, metres)
        elif name.endswith(".npz"):
            np.savez_compressed(folder / name, depth=metres)
        else:
            cv2.imwrite(str(folder / name), (1000 * metres).astype(np.uint16))


def lines(file: Path, rows: list[str]) -> None:
    """Write a text file.

    Args:
        file: its folder is made if need be.
        rows: without ends of line.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(rows) + "\n", encoding="utf-8")


def poses(count: int = COUNT, step: float = 0.05, first: float = 0.0) -> list[str]:
    """Rows ``timestamp tx ty tz qx qy qz qw``.

    Args:
        count: of rows.
        step: seconds between them.
        first: time of the first, seconds.
    """
    return [f"{first + step * i:.6f} {0.1 * i:.3f} {0.02 * i:.3f} 0 0 0 {np.sin(0.05 * i):.9f} {np.cos(0.05 * i):.9f}"
            for i in range(count)]  # fmt: skip


def _tum(folder: Path) -> None:
    stamps = [f"{1000 + 0.05 * i:.6f}" for i in range(COUNT)]
    for kind in ("rgb", "depth"):
        lines(folder / "s" / f"{kind}.txt", ["# time file", *(f"{stamp} {kind}/{stamp}.png" for stamp in stamps)])
    images(folder / "s" / "rgb", [f"{stamp}.png" for stamp in stamps])
    depths(folder / "s" / "depth", [f"{stamp}.png" for stamp in stamps])
    lines(folder / "s" / "groundtruth.txt", ["# time pose", *poses(30, 0.01, 999.99)])
    lines(folder / "s" / "calib.txt", [K])


def _euroc(folder: Path) -> None:
    mav = folder / "s" / "mav0"
    stamps = [1_403_636_579_763_555_584 + 50_000_000 * i for i in range(COUNT)]
    for number in (0, 1):
        camera = mav / f"cam{number}"
        images(camera / "data", [f"{stamp}.png" for stamp in stamps])
        lines(camera / "data.csv", ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)])
        lines(camera / "sensor.yaml", [
            "sensor_type: camera", "T_BS:", "  cols: 4", "  rows: 4",
            f"  data: [1, 0, 0, {0.1 * number}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]",
            f"resolution: [{WIDTH}, {HEIGHT}]", "camera_model: pinhole", "intrinsics: [50, 51, 31.5, 23.5]",
            "distortion_model: radial-tangential", "distortion_coefficients: [-0.1, 0.02, 0.0001, 0.0002]",
        ])  # fmt: skip
    matrix = "data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
    for name in ("imu0", "state_groundtruth_estimate0"):
        lines(mav / name / "sensor.yaml", ["T_BS:", "  cols: 4", "  rows: 4", f"  {matrix}"])
    samples = range(stamps[0] - 10_000_000, stamps[-1] + 20_000_000, 5_000_000)
    lines(mav / "imu0" / "data.csv", ["#timestamp", *(f"{t},0.1,0.2,0.3,0.1,9.8,0.2" for t in samples)])
    lines(mav / "state_groundtruth_estimate0" / "data.csv",
          ["#timestamp", *(f"{t},{1e-9 * (t - stamps[0]):.4f},2,3,1,0,0,0,0,0,0" for t in samples)])  # fmt: skip


def _kitti(folder: Path) -> None:
    sequence = folder / "sequences" / "07"
    for camera in ("image_0", "image_1"):
        images(sequence / camera, [f"{i:06d}.png" for i in range(COUNT)])
    lines(sequence / "calib.txt",
          [f"P{i}: 50 0 31.5 {-20.0 * (i % 2)} 0 50 23.5 0 0 0 1 0" for i in range(4)])  # fmt: skip
    lines(sequence / "times.txt", [f"{0.1 * i:e}" for i in range(COUNT)])
    lines(folder / "poses" / "07.txt", [f"1 0 0 {0.1 * i} 0 1 0 0 0 0 1 {0.5 * i}" for i in range(COUNT)])


def _tartanair(folder: Path, version: int) -> None:
    left, right = ("left", "right") if version == 1 else ("lcam_front", "rcam_front")
    for side in (left, right):
        images(folder / "s" / f"image_{side}", [f"{i:06d}_{side}.png" for i in range(COUNT)])
    ends = [".npy", ".npz", ".npy", ".npz"] if version == 1 else []
    depths(folder / "s" / f"depth_{left}", [f"{i:06d}_{left}_depth{end}" for i, end in enumerate(ends)])
    if version == 2:
        for i in range(COUNT):
            metres = np.full((HEIGHT, WIDTH), 2.0, "<f4").view(np.uint8).reshape(HEIGHT, WIDTH, 4)
            cv2.imwrite(str(folder / "s" / f"depth_{left}" / f"{i:06d}_{left}_depth.png"), metres)
        lines(folder / "s" / "imu" / "cam_time.txt", [f"{0.1 * i:.3f}" for i in range(COUNT)])
    lines(folder / "s" / f"pose_{left}.txt", [row.split(maxsplit=1)[1] for row in poses()])
    lines(folder / "s" / "calib.txt", [K])


def _tartanair_test(folder: Path) -> None:
    images(folder / "mono" / "ME000", [f"{i:06d}.png" for i in range(COUNT)])
    lines(folder / "mono_gt" / "ME000.txt", [row.split(maxsplit=1)[1] for row in poses()])
    lines(folder / "mono" / "ME000" / "calib.txt", [K])


def _icl_nuim(folder: Path) -> None:
    place = folder / "living_room_traj0_loop"
    images(place / "rgb", [f"{i}.png" for i in range(COUNT)])
    depths(place / "depth", [f"{i}.png" for i in range(COUNT)])
    rows = [row.split(maxsplit=1)[1] for row in poses()]
    lines(place / "livingRoom0.gt.freiburg", [f"{i + 1} {row}" for i, row in enumerate(rows)])
    lines(place / "calib.txt", [K])


def _sequence(folder: Path) -> None:
    images(folder / "s" / "left", [f"{i}.color.jpg" for i in range(COUNT)])
    images(folder / "s" / "right", [f"{i}.color.jpg" for i in range(COUNT)])
    depths(folder / "s" / "depth", [f"{i}.depth.png" for i in range(COUNT)])
    lines(folder / "s" / "calib.yaml", [
        "fx: 50", "fy: 51", "cx: 31.5", "cy: 23.5", f"width: {WIDTH}", f"height: {HEIGHT}", "model: fisheye",
        "coefficients: [0.01, 0.002, 0.0003, 0.0001]", "depth_scale: 1000", "baseline: 0.1",
    ])  # fmt: skip
    lines(folder / "s" / "groundtruth_tum.txt", poses())


def _folder(folder: Path) -> None:
    names = ["a1.png", "a2.jpg", "a3.bmp", "a4.tiff", "a5.webp", "a6.ppm", "a7.pgm"]
    images(folder / "s", names)
    lines(folder / "s" / "times.txt", [f"{0.1 * i:.3f}" for i in range(len(names))])
    lines(folder / "s" / "calib.txt", [f"{K} -0.1 0.01 0.001 0.001"])


def _named_by_time(folder: Path) -> None:
    images(folder / "s", [f"{1_403_636_579_763_555_584 + 50_000_000 * i}_{k}.png" for i in range(3) for k in (0, 1)])
    lines(folder / "calib.txt", [K])


def _video(folder: Path, ending: str, codec: str) -> None:
    writer = cv2.VideoWriter(str(folder / f"v{ending}"), cv2.VideoWriter.fourcc(*codec), 20.0, (WIDTH, HEIGHT))
    for index in range(8):
        writer.write(picture(index))
    writer.release()
    lines(folder / "calib.txt", [K])
    lines(folder / "times.txt", [f"{0.05 * i:.3f}" for i in range(8)])
    lines(folder / "truth.txt", poses(8))


def _read(folder: Path, random: np.random.Generator | None, place: str, options: tuple[str, ...] = ()) -> None:
    """Open a source with some of the options, read its first frames, and check them with the ground truth."""
    path = folder / place
    given: dict[str, object] = {}
    for option in options:
        name, _, file = option.partition("=")
        if name == "calib" or not chance(random, 0.5):
            given[name] = folder / file
    if random is not None and chance(random, 0.1) and "times" not in given:
        given["fps"] = float(random.choice([0.0, -1.0, np.nan, np.inf, 1e-320, 1e-9, 30.0, 1e9, 1e308]))
    if random is not None and chance(random, 0.1):
        given["stride"] = int(random.choice([-1, 0, 1, 2, 10**9]))
    source = open_source(path, undistort=not chance(random, 0.3), **given)  # type: ignore[arg-type]
    if source.groundtruth is not None:
        check_trajectory(source.groundtruth)
    check_frames(source)
    require(all(isinstance(warning, str) for warning in source.warnings), "warnings that are no text")


def _target(name: str, build: object, place: str, *options: str) -> Target:
    return Target(name, build, partial(_read, place=place, options=options), modules=MODULES)  # type: ignore[arg-type]


TARGETS = (
    _target("tum", _tum, "s"),
    _target("euroc", _euroc, "s"),
    _target("kitti", _kitti, "sequences/07"),
    _target("tartanair", partial(_tartanair, version=1), "s"),
    _target("tartanair_v2", partial(_tartanair, version=2), "s"),
    _target("tartanair_test", _tartanair_test, "mono/ME000"),
    _target("icl_nuim", _icl_nuim, "living_room_traj0_loop"),
    _target("sequence", _sequence, "s"),
    _target("folder", _folder, "s", "calib=s/calib.txt"),
    _target("named_by_time", _named_by_time, "s", "calib=calib.txt"),
    _target(
        "video_avi",
        partial(_video, ending=".avi", codec="MJPG"),
        "v.avi",
        "calib=calib.txt",
        "times=times.txt",
        "groundtruth=truth.txt",
    ),  # fmt: skip
    _target(
        "video_mp4",
        partial(_video, ending=".mp4", codec="mp4v"),
        "v.mp4",
        "calib=calib.txt",
        "times=times.txt",
        "groundtruth=truth.txt",
    ),  # fmt: skip
)
