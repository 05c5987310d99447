"""Several writers of one file: two processes with two threads each, for every kind of output, while it is read."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from dvo.boards.calibrate import HEADER
from dvo.core.errors import DvoError
from dvo.data.calibration.read import read_calibration
from dvo.data.files.output import PART, replaced, write_text
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum, write_kitti_poses, write_tum
from dvo.map.io.map_file import open_map_file, write_map_file
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import load_weights, save_weights
from dvo.nets.patch.config import preset
from dvo.odometry.loops.place_descriptors import GridDescriptor, save_descriptor
from dvo.odometry.protocol import SparseMap
from dvo.session.files import read_ply, write_ply
from dvo.viz.plot import Panel, Track, plot_panels

WRITERS = """
import sys, threading
from tests.faults.writers import write_for
threads = [threading.Thread(target=write_for, args=(sys.argv[1], float(sys.argv[2]), k)) for k in range(2)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
"""


@dataclass(frozen=True)
class Kind:
    """An output.

    Attributes:
        file: its name.
        write: writes it, from a number that makes contents differ.
        read: raises an exception if it is not whole.
    """

    file: str
    write: Callable[[Path, int], object]
    read: Callable[[Path], object]


def _poses(number: int) -> np.ndarray:
    rows = np.zeros((40 + number % 7, 7))
    rows[:, 0], rows[:, 6] = np.arange(len(rows)) + number, 1
    return rows


def _trajectory(number: int) -> Trajectory:
    rows = _poses(number)
    return Trajectory(0.1 * np.arange(len(rows)), rows)


def _map(file: Path, number: int) -> None:
    values = np.full(20000 + number % 9, number % 100, np.float32)
    write_map_file(file, {"number": number}, {"a/values": values})


def _read_map(file: Path) -> None:
    with open_map_file(file) as found:
        values = found.array("a/values", np.float32, (None,))
        assert np.ptp(values) == 0


def _ply(file: Path, number: int) -> None:
    points = np.full((3000 + number % 5, 3), number % 100, np.float32)
    with replaced(file) as part:
        write_ply(part, SparseMap(points, np.zeros((len(points), 3), np.uint8)))


def _picture(file: Path, number: int) -> None:
    with replaced(file) as part:
        cv2.imwrite(str(part), np.full((240, 320, 3), number % 250, np.uint8))


def _read_picture(file: Path) -> None:
    image = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and np.ptp(image) == 0


def _plot(file: Path, number: int) -> None:
    with replaced(file) as part:
        plot_panels(part, [Panel((Track(_trajectory(number), "track", 0),), np.zeros((0, 3)))], title="", subtitle="")


def _weights(file: Path, number: int) -> None:
    torch.manual_seed(number)
    save_weights(file, PatchVO(preset("tiny")), {"number": number})


def _descriptor(file: Path, number: int) -> None:
    save_descriptor(
        file, GridDescriptor(np.zeros((2, 2, 8), np.float32), np.zeros((8, 4), np.float32)), {"number": number}
    )


def _read_descriptor(file: Path) -> None:
    from safetensors import safe_open

    with safe_open(file, "np") as found:
        assert set(found.keys()) == {"mean", "projection"}


KINDS: tuple[Kind, ...] = (
    Kind("a.dvo", _map, _read_map),
    Kind("trajectory.txt", lambda file, k: write_tum(file, _trajectory(k)), read_tum),
    Kind("poses.txt", lambda file, k: write_kitti_poses(file, _poses(k)), read_kitti_poses),
    Kind("map.ply", _ply, read_ply),
    Kind("sheet.png", _picture, _read_picture),
    Kind("run.json", lambda file, k: write_text(file, json.dumps({"rows": [k] * 3000})),
         lambda file: json.loads(file.read_text())),
    Kind("calib.txt", lambda file, k: write_text(file, f"{HEADER}\n{50 + k % 9} 51 31.5 23.5\n"), read_calibration),
    Kind("weights.safetensors", _weights, load_weights),
    Kind("plot.png", _plot, lambda file: cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), 1).shape),
    Kind("descriptor.safetensors", _descriptor, _read_descriptor),
)  # fmt: skip


def write_for(place: str, seconds: float, seed: int) -> None:
    """Write all kinds in turn, twice at least, and print a JSON line with the failures of each.

    Args:
        place: folder.
        seconds: to go on.
        seed: of the first content.
    """
    torch.set_num_threads(1)
    end, count, rounds, saves = time.monotonic() + seconds, seed * 1000, 0, Counter[str]()
    while time.monotonic() < end or rounds < 2:
        rounds += 1
        for kind in KINDS:
            try:
                kind.write(Path(place) / kind.file, count)
                saves[kind.file] += 1
            except Exception as error:  # whatever it is, it is what this trial looks for
                saves[f"{kind.file} failed"] += 1
                print(f"{kind.file}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            count += 1
    sys.stdout.write(json.dumps(saves) + "\n")  # one call for a line: there are two threads
    sys.stdout.flush()


def trial(place: Path, seconds: float) -> tuple[str, bool]:
    """Write and read for a while.

    Args:
        place: an empty folder.
        seconds: to go on.

    Returns:
        Table, and whether a save failed or a read met half a file.
    """
    command = [sys.executable, "-c", WRITERS, str(place), str(seconds)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    counts: Counter[str] = Counter()
    goes_on = True
    while goes_on:
        goes_on = any(process.poll() is None for process in running)  # each is read once more at the end
        for kind in KINDS:
            file = place / kind.file
            if not file.exists():
                continue
            counts[f"{kind.file} reads"] += 1
            try:
                kind.read(file)
            except (Exception, DvoError) as error:
                counts[f"{kind.file} corrupt"] += 1
                print(f"{kind.file}: {type(error).__name__}: {error}", file=sys.stderr)
    for process in running:
        for line in process.communicate()[0].splitlines():
            found: dict[str, Any] = json.loads(line)
            for name, value in found.items():
                counts[name if "failed" in name else f"{name} saves"] += value
    left = [file.name for file in place.iterdir() if file.name.startswith(PART)]
    rows = [f"{'output':24s}{'saves':>8s}{'failed':>8s}{'reads':>8s}{'corrupt':>8s}"]
    for kind in KINDS:
        cells = [counts[f"{kind.file} {what}"] for what in ("saves", "failed", "reads", "corrupt")]
        rows.append(f"{kind.file:24s}" + "".join(f"{cell:8d}" for cell in cells))
    rows.append(f"parts left: {len(left)}")
    failed = sum(value for name, value in counts.items() if name.endswith((" failed", " corrupt"))) + len(left)
    return "\n".join(rows), bool(failed or any(process.returncode for process in running))
