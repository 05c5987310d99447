"""Signals at random times of ``dvo run --save-map --export colmap``, and what lies in the folder afterwards."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from collections import Counter
from pathlib import Path

import numpy as np

from dvo.data.files.output import LOCK
from dvo.data.trajectory import read_tum
from dvo.session.files import read_ply
from dvo.session.results import EXPORT, SEGMENT_FILE
from dvo.synth.export import export_sequence
from dvo.synth.sequence import make_sequence

SIGNALS = {signal.SIGTERM: (143,), signal.SIGHUP: (129,), signal.SIGKILL: (-signal.SIGKILL,)}
"""Exit codes that belong to a signal; a run may also have ended before it came."""
SETTINGS = (
    "pixels=6912", "patches=6", "lifetime=4", "removal=5", "optimisation=4", "initial_frames=5", "initial_updates=3",
    "final_updates=1", "initial_motion=0", "initial_parallax=0", "keyframe_motion=0", "lost_confidence=0",
    "min_inliers=0", "search_inliers=0", "join_inliers=0", "initial_inliers=0", "search_updates=1",
)  # fmt: skip
"""A small odometry: what it finds does not matter here."""


def trial(place: Path, count: int, seed: int) -> tuple[str, bool]:
    """Run, disturb, and look.

    Args:
        place: an empty folder.
        count: number of runs of each signal.
        seed: of the times.

    Returns:
        Table, and whether anything was wrong.
    """
    clip = place / "clip"
    export_sequence(make_sequence(4, frames=20, family="room", kind="sideways", height=72, width=96), clip, "tum")
    draw, counts, wrong = random.Random(seed), Counter[tuple[str, str]](), []
    whole = _run(clip, place / "whole", None, 0.0)[1]
    for number in SIGNALS:
        for run in range(count):
            folder = place / f"{number.name}{run}"
            code, _ = _run(clip, folder, number, draw.uniform(0.0, 1.05 * whole))
            ended = "in time" if code in SIGNALS[number] else "before it"
            counts[number.name, ended] += 1
            found = _faults(folder, code, number)
            wrong += [f"{number.name} {run}: {fault}" for fault in found]
            counts[number.name, "wrong"] += bool(found)
    rows = [f"{'signal':10s}{'runs':>6s}{'stopped':>9s}{'ended before':>14s}{'wrong':>7s}"]
    for number in SIGNALS:
        cells = [counts[number.name, what] for what in ("in time", "before it", "wrong")]
        rows.append(f"{number.name:10s}{count:6d}{cells[0]:9d}{cells[1]:14d}{cells[2]:7d}")
    return "\n".join([*rows, f"a run takes {whole:.1f} s", *wrong]), bool(wrong)


def _run(clip: Path, folder: Path, number: signal.Signals | None, after: float) -> tuple[int, float]:
    """Run the command in a fork, where everything is imported; its exit code and seconds."""
    import dvo.commands.run  # noqa: F401
    import dvo.export.reconstruction  # noqa: F401
    import dvo.odometry.load
    import dvo.viz.plot  # noqa: F401
    from dvo.cli import main

    settings = [part for setting in SETTINGS for part in ("--set", setting)]
    line = ["run", str(clip), "--out", str(folder), "--save-map", f"{folder}.dvo", "--export", "colmap,tum",
            "--device", "cpu", *settings]  # fmt: skip
    begin = time.monotonic()
    child = os.fork()
    if child == 0:
        log = os.open(f"{folder}.log", os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 1)
        os.dup2(log, 2)
        for handled in (signal.SIGHUP, signal.SIGTERM):  # also under nohup
            signal.signal(handled, signal.SIG_DFL)
        os._exit(main(line))
    if number is not None:
        time.sleep(after)
        os.kill(child, number)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code, time.monotonic() - begin


def _faults(folder: Path, code: int, number: signal.Signals) -> list[str]:
    """What is not as it should be after a run."""
    found = []
    text = Path(f"{folder}.log").read_text(errors="replace")
    if "Traceback" in text:
        found.append(f"traceback: {text[-300:]!r}")
    if code not in (0, *SIGNALS[number]):
        found.append(f"exit code {code}: {text[-300:]!r}")
    if not folder.exists():
        return found
    try:
        facts = json.loads((folder / "run.json").read_text()) if (folder / "run.json").exists() else None
        rows = [file for file in folder.iterdir() if file.name == "trajectory.txt" or SEGMENT_FILE.fullmatch(file.name)]
        for file in rows:
            if file.stat().st_size > 100:
                assert np.isfinite(read_tum(file).poses_wc).all()
        if (folder / "map.ply").exists():
            read_ply(folder / "map.ply")
        if Path(f"{folder}.dvo").exists():
            from dvo.map.io.serialisation import load_graph

            load_graph(f"{folder}.dvo")
        for name in ("colmap", "tum"):
            export = folder / EXPORT / name
            if export.exists():
                last = export / ("times.txt" if name == "colmap" else "trajectory.txt")
                assert last.is_file(), f"half an export of {name}"
        if facts is None and rows:
            found.append("a trajectory without run.json")
        if number != signal.SIGKILL:
            left = [file.name for file in folder.rglob(".*")]
            if left:
                found.append(f"left {left}")
            if code != 0 and facts is not None and rows and not facts["interrupted"]:
                found.append("run.json does not tell of the interruption")
        elif (folder / LOCK).exists():
            from dvo.data.files.output import only_writer

            with only_writer(folder, "--out"):
                pass
    except Exception as error:  # whatever it is, a file is not whole
        found.append(f"{type(error).__name__}: {error}")
    return found
