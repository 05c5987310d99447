"""Ground truth of public benchmarks that is neither TUM nor KITTI, rewritten with the times of the images.

- TartanAir's monocular test set (``mono/ME000/*.png``, ``mono_gt/ME000.txt``): a row ``tx ty tz qx qy qz qw`` an image,
  NED camera to world, no times.
- ICL-NUIM (``TrajectoryGT/livingRoom0.gt.freiburg``): TUM rows whose stamps count frames from 1, the first image being
  number 1 (so DPVO pairs them).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dvo.data.images import has_images, list_images
from dvo.data.tartanair import NOMINAL_FPS, read_ned_poses
from dvo.data.trajectory import Trajectory, read_tum, write_tum
from eval.suites.suite import Sequence

ICL_FPS = 30.0


def adopt(sequence: Sequence, data: Path, scratch: Path) -> Sequence:
    """The sequence itself, or, where its ground truth has one of the two formats, one whose files lie in ``scratch``.

    Raises:
        DvoError: a malformed ground truth.
    """
    images = data / sequence.path
    truth = images / sequence.groundtruth if sequence.groundtruth else None
    if truth is None or not truth.is_file() or sequence.times is not None or not has_images(images):
        return sequence
    columns = _first_row(truth)
    if len(columns) == 7:
        poses, rate = read_ned_poses(truth), NOMINAL_FPS
        numbers = np.arange(len(poses))
    elif truth.suffix == ".freiburg" and len(columns) == 8:
        counted = read_tum(truth)
        poses, rate = counted.poses_wc, ICL_FPS
        numbers = counted.timestamps - 1
    else:
        return sequence
    scratch.mkdir(parents=True, exist_ok=True)
    write_tum(scratch / "groundtruth.txt", Trajectory(numbers / rate, poses))
    times = np.arange(len(list_images(images))) / rate
    (scratch / "times.txt").write_text("".join(f"{time:.9f}\n" for time in times), encoding="utf-8")
    made = scratch.resolve()
    return replace(sequence, times=str(made / "times.txt"), groundtruth=str(made / "groundtruth.txt"))


def _first_row(path: Path) -> list[str]:
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.strip() and not line.startswith("#"):
                return line.split()
    return []
