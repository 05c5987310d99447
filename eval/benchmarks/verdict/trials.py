"""Trials of the benchmark of verdicts: a rendered clip, what is done to it, and what its run amounts to."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

import dvo
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.session import session
from dvo.session.results import jsonable
from dvo.synth.sequence import make_sequence
from eval.benchmarks.verdict import failures
from eval.systems.registry import find_system

CHANGES: dict[str, failures.Change] = {
    "overlay": failures.with_overlay,
    "crowd": failures.with_crowd,
    "waves": failures.with_waves,
    "crop": failures.with_floating_crop,
    "focal": failures.with_wrong_focal,
    "lens": failures.through_bent_lens,
    "still": failures.before_still_camera,
}
KINDS = ("right", *CHANGES, "dropped", "weights")
FRAMES = 48
FAMILIES = ("room", "corridor", "street", "clutter", "tabletop", "planes", "terrain", "forest", "hall", "courtyard",
            "gallery")  # fmt: skip
PATHS = ("handheld", "forward", "sideways", "orbit", "drone", "stop_and_go", "straight", "fast")
CONDITIONS: tuple[dict[str, Any], ...] = (
    {}, {}, {}, {"texture": 0.15}, {"lighting": 2.0}, {"light": 0.05}, {"movers": 8},
    {"kind": "fast", "shutter": 0.5}, {"rolling_shutter": 0.5, "shake": 4.0}, {"kind": "rotation"},
)  # fmt: skip
WRONG, TIMES = 2.0, 5.0
"""ATE in percent of the path, and multiple of the best, above which a run is wrong."""
TURNED = 0.5
"""RPE of the rotation in degrees above which a run of a camera that turns on the spot is wrong."""


@dataclass(frozen=True)
class Trial:
    """Run to make.

    Attributes:
        kind: of :data:`KINDS`.
        number: of its scene; even ones were there to choose thresholds by.
    """

    kind: str
    number: int

    @property
    def options(self) -> dict[str, Any]:
        """Settings of the clip."""
        n = self.number
        found = {"family": FAMILIES[n % len(FAMILIES)], "kind": PATHS[(n // 3 + n) % len(PATHS)], "fps": 15.0}
        if self.kind == "right":
            found |= CONDITIONS[n // 2 % len(CONDITIONS)]
        if self.kind == "dropped":
            found |= {"kind": ("fast", "handheld")[n % 2], "fps": (1.5, 2.0, 3.0)[n % 3], "speed": 2.0}
        if self.kind in ("focal", "lens"):
            found |= {"kind": ("orbit", "handheld", "fast")[n % 3]}
        return found

    def clip(self) -> tuple[list[Frame], Trajectory]:
        """Frames as rendered, and their ground truth."""
        seed = 50_000 + 100 * (zlib.crc32(self.kind.encode()) % 1000) + self.number
        sequence = make_sequence(seed, frames=FRAMES, height=240, width=320, **self.options)
        return list(sequence), sequence.groundtruth


@dataclass(frozen=True)
class Outcome:
    """Run, with what it amounts to.

    Attributes:
        kind, number: of the trial.
        wrong: the run is.
        ate: percent of the path; None without enough poses, and before a still camera.
        best: lowest ATE of the systems that were tried on the clip as rendered; None if the run is below :data:`WRONG`.
        poses: number of rows.
        quality: of the result, as in run.json.
    """

    kind: str
    number: int
    wrong: bool
    ate: float | None
    best: float | None
    poses: int
    quality: dict[str, Any] = field(default_factory=dict)


def carry_out(trial: Trial) -> Outcome:
    """Carry out a trial."""
    frames, truth = trial.clip()
    changed: Sequence[Frame] = frames
    if trial.kind in CHANGES:
        rng = np.random.default_rng([trial.number, zlib.crc32(trial.kind.encode())])
        changed = list(CHANGES[trial.kind](rng, frames, trial.number))

    def build(seed: int) -> PatchOdometry:
        odometry = dvo.load("small", device="cpu", seed=seed, loops=False)
        assert isinstance(odometry, PatchOdometry)
        if trial.kind == "weights":
            failures.spoil(odometry.network, trial.number)
        return odometry

    result = session.run(build(0), changed, again=build).result
    assert result.quality is not None
    quality = jsonable(asdict(result.quality))
    rows = len(result.trajectory)
    if trial.kind == "still":
        return Outcome(trial.kind, trial.number, rows > 0, None, None, rows, quality)
    found = evaluate(result.trajectory, truth)
    if trial.options["kind"] == "rotation":
        return Outcome(trial.kind, trial.number, found.rpe_rot_deg > TURNED, None, None, rows, quality)
    ate, best = None if found.reason else found.ate_percent, None
    if ate is not None and ate > WRONG:
        best = min(_ate(name, frames, truth) for name in ("dvo-small", "keyframe", "klt-pnp"))
    wrong = ate is not None and ate > max(WRONG, TIMES * (best or 0.0))
    return Outcome(trial.kind, trial.number, wrong, ate, best, rows, quality)


def _ate(name: str, frames: Sequence[Frame], truth: Trajectory) -> float:
    found = evaluate(session.run(find_system(name).build(0, "cpu"), frames).result.trajectory, truth)
    return math.inf if found.reason else found.ate_percent
