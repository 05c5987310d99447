"""Rendered sequences, kept on disk: made once, read back by the same readers as recordings, the same for every system.

A folder of the cache has the layout of TUM RGB-D (``rgb.txt``, ``rgb/``, ``groundtruth.txt``) with ``calib.txt``, so
that other people's tools read it too; with a rolling shutter ``calib.yaml`` instead, which states the readout. It
appears under its name only when it is whole. Motions of hands and quadrotors have exact inertial samples beside the
images (:mod:`eval.suites.inertial`).
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.output import scratch_folder
from dvo.data.readers.tum import RIGHT
from dvo.data.trajectory import write_tum
from eval.suites.inertial import write_exact

RECORD = "sequence.json"


def cache_folder() -> Path:
    """``$DVO_CACHE/suites``, else ``~/.cache/dvo/suites``; made if need be.

    Raises:
        DvoError: it cannot be made.
    """
    folder = Path(os.environ.get("DVO_CACHE") or Path.home() / ".cache" / "dvo") / "suites"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DvoError(
            str(error.strerror), file=folder, field="DVO_CACHE", remedy="set it to another folder"
        ) from error
    return folder


def place_of(name: str, options: dict[str, Any]) -> Path:
    """The folder of a sequence; another one whenever name, version or an option is another.

    Args:
        name: of the sequence.
        options: of the rendering, with its version.
    """
    text = json.dumps(options, sort_keys=True)
    return cache_folder() / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def rendered_folder(name: str, options: dict[str, Any]) -> Path:
    """The folder of a rendered sequence, rendered now unless it is there.

    Args:
        name: of the sequence.
        options: of :func:`dvo.synth.make_sequence`, and ``version``; with ``depth``, depth images are written too, with
            ``baseline`` the images of a right camera at that many metres.

    Raises:
        DvoError: options that cannot be rendered, or a folder that cannot be written.
    """
    folder = place_of(name, options)
    if (folder / RECORD).is_file():
        return folder
    try:
        with scratch_folder(folder.name, folder.parent) as part:
            _write(part, name, options)
            try:
                part.rename(folder)
            except OSError:
                if not (folder / RECORD).is_file():  # else another process was faster, with the same bytes
                    raise
    except OSError as error:
        raise DvoError(str(error), file=folder, field="DVO_CACHE", remedy="make room or set another folder") from error
    return folder


def _write_image(file: Path, image: np.ndarray) -> None:
    import cv2  # imported here, like rendering: the evaluation of recordings needs neither

    file.parent.mkdir(exist_ok=True)
    if not cv2.imwrite(str(file), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {file.name}")


def _write(folder: Path, name: str, options: dict[str, Any]) -> None:
    from dvo.synth.export import write_calibration, write_depth
    from dvo.synth.motion.natural import NATURAL_KINDS
    from dvo.synth.sequence import make_sequence

    begin, clock = time.perf_counter(), time.process_time()
    chosen = {key: value for key, value in options.items() if key not in ("version", "depth", "baseline")}
    try:
        sequence = make_sequence(**chosen)
    except TypeError as error:
        raise DvoError(f"options that cannot be rendered ({error})", field=name, remedy="fix the suite") from error
    baseline = float(options.get("baseline", 0))
    right = sequence.stereo(baseline) if baseline else None
    rows = ["# timestamp filename"]
    for frame in sequence:
        file = f"rgb/{frame.timestamp:.6f}.png"
        _write_image(folder / file, frame.image)
        if right is not None:
            _write_image(folder / RIGHT / Path(file).name, right.frame(frame.index).image)
        rows.append(f"{frame.timestamp:.9f} {file}")
        if options.get("depth"):
            write_depth(folder, f"{frame.timestamp:.6f}", sequence.rendering(frame.index).depth[0].cpu().numpy())
    (folder / "rgb.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    write_tum(folder / "groundtruth.txt", sequence.groundtruth)
    write_calibration(sequence.camera, folder, baseline)
    if options.get("kind") in NATURAL_KINDS:
        write_exact(folder, sequence, options["kind"], options["frames"] / options["fps"])
    facts = {
        "name": name, "options": options, "scene": sequence.name, "frames": len(sequence),
        "path_m": round(sequence.groundtruth.path_length, 4), "seconds": round(time.perf_counter() - begin, 2),
        "processor_seconds": round(time.process_time() - clock, 2),
    }  # fmt: skip
    (folder / RECORD).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
