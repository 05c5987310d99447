"""Trajectories as files of TUM, KITTI and EuRoC. Poses are camera to world, camera x right, y down, z forward."""

from __future__ import annotations

from pathlib import Path

from dvo.data.trajectory import Trajectory, write_kitti_poses, write_tum

EUROC_HEADER = "#timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z\n"


def write_tum_trajectory(trajectory: Trajectory, folder: Path) -> None:
    """Write trajectory.txt, rows ``timestamp tx ty tz qx qy qz qw`` in seconds.

    Args:
        trajectory: camera-to-world poses.
        folder: an existing folder.

    Raises:
        OSError: the file cannot be written.
    """
    write_tum(folder / "trajectory.txt", trajectory)


def write_kitti_trajectory(trajectory: Trajectory, folder: Path) -> None:
    """Write poses.txt, rows of the 3x4 matrix ``T_wc``, and times.txt, the seconds of each row.

    The format has a row for every frame and no times, so frames without a pose shift the rows after them; times.txt
    tells which frames the rows belong to.

    Args:
        trajectory: camera-to-world poses.
        folder: an existing folder.

    Raises:
        OSError: a file cannot be written.
    """
    write_kitti_poses(folder / "poses.txt", trajectory.poses_wc)
    rows = "".join(f"{time:.9f}\n" for time in trajectory.timestamps.tolist())
    (folder / "times.txt").write_text(rows, encoding="ascii", newline="\n")


def write_euroc_trajectory(trajectory: Trajectory, folder: Path) -> None:
    """Write trajectory.csv, rows ``ns, x, y, z, qw, qx, qy, qz`` as in EuRoC's ``state_groundtruth_estimate0``.

    Times are integers of nanoseconds, the nearest to the seconds (float64 seconds of a clock that counts from 1970 are
    exact to 0.2 microseconds). The pose is that of the camera, where EuRoC's own files have that of the body.

    Args:
        trajectory: camera-to-world poses.
        folder: an existing folder.

    Raises:
        OSError: the file cannot be written.
    """
    lines = [EUROC_HEADER]
    for time, (x, y, z, qx, qy, qz, qw) in zip(
        trajectory.timestamps.tolist(), trajectory.poses_wc.tolist(), strict=True
    ):
        lines.append(f"{round(time * 1e9)}," + ",".join(f"{value:z.9f}" for value in (x, y, z, qw, qx, qy, qz)) + "\n")
    (folder / "trajectory.csv").write_text("".join(lines), encoding="ascii", newline="\n")
