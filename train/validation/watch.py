"""Validation while training: the real tracker runs on a few clips with the averaged weights."""

from __future__ import annotations

import copy
import time
from itertools import islice
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np

from dvo.data.files.root import data_root
from dvo.data.frame import Frame
from dvo.data.open import open_source
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics
from dvo.models.weights import LoadedWeights
from dvo.odometry.load import build_odometry
from dvo.odometry.protocol import Estimate, Odometry
from dvo.odometry.registry import odometry_builder
from dvo.session.session import Run
from train.engine.baseline import undisturbed
from train.validation.pictures import PatchFlow, draw, image_at, patch_flow
from train.validation.validate import rendered_clip, track_sequence

Clip = tuple[str, list[Frame], Trajectory]


def track_with_flow(
    odometry: Odometry, frames: list[Frame], truth: Trajectory
) -> tuple[Metrics, Run, PatchFlow | None]:
    """Track a clip as :func:`train.validation.validate.track_sequence` does, with the flow of the last window."""
    flow: PatchFlow | None = None

    def keep_flow(frame: Frame, _: Estimate | None) -> None:
        nonlocal flow
        if frame is frames[-1]:  # finishing empties the window
            flow = patch_flow(odometry)

    metrics, done = track_sequence(odometry, frames, truth, keep_flow)
    return metrics, done, flow


class TrackWhileTraining(L.Callback):
    """Tracks rendered clips of the validation seed and, where ``DVO_DATA`` is, real sequences, every so many steps.

    Works for every network with an odometry, see :data:`dvo.odometry.registry.ODOMETRIES`.

    Logs ATE (Sim(3), % of path) and rotation error over rotation for each clip and as medians; writes a picture of each
    clip to ``dirpath/pictures`` and to TensorBoard. Training itself sees nothing of it: no random number is drawn from
    its states, and the time is left out of its timing.

    Args:
        dirpath: folder of the run; None: that of the trainer.
        every: steps between validations.
        rendered: number of rendered clips.
        frames: length of each of them.
        size: height and width of each of them, pixels.
        fps: frames a second of each of them.
        sequences: names of real sequences under ``DVO_DATA``; missing ones are left out.
        real_frames: only the first so many frames of each real sequence.
        limit_s: no further clip is begun after this many seconds.
    """

    def __init__(
        self,
        dirpath: str | None = None,
        every: int = 1000,
        rendered: int = 2,
        frames: int = 40,
        size: tuple[int, int] = (120, 160),
        fps: float = 10.0,
        sequences: list[str] | None = None,
        real_frames: int = 40,
        limit_s: float = 60.0,
    ) -> None:
        self.dirpath, self.every, self.limit_s = dirpath, every, limit_s
        self.rendered, self.frames, self.size, self.fps = rendered, frames, size, fps
        self.sequences, self.real_frames = sequences or [], real_frames
        self._clips: list[Clip] | None = None
        self._last = -1

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Check that there is an odometry for the network, before time is spent, and validate trained weights.

        Raises:
            DvoError: there is none.
        """
        odometry_builder(pl_module.average.architecture)
        if getattr(pl_module, "from_trained", False):
            self._validate_now(trainer, pl_module)
        self._last = trainer.global_step

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Validate if it is time."""
        self._validate_if_due(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Validate the final weights."""
        if trainer.global_step >= trainer.max_steps >= 0:  # not after Ctrl-C, when somebody waits
            self._validate_if_due(trainer, pl_module)

    def _validate_if_due(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        step = trainer.global_step
        if step % self.every or step == self._last:
            return
        self._last = step
        self._validate_now(trainer, pl_module)

    def _validate_now(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        start = time.perf_counter()
        if trainer.is_global_zero:
            with undisturbed():
                self._validate(trainer, pl_module, start)
        trainer.strategy.barrier()
        pl_module.leave_out_of_timing(time.perf_counter() - start)

    def _validate(self, trainer: L.Trainer, program: Any, start: float) -> None:
        step, folder = trainer.global_step, Path(self.dirpath or trainer.default_root_dir) / "pictures"
        if self._clips is None:
            self._clips = [*self._rendered_clips(), *self._real_clips()]
            start = time.perf_counter()  # reading and rendering them is paid once
        weights = LoadedWeights.of(copy.deepcopy(program.average).eval(), "training")
        found: dict[str, float] = {}
        for name, frames, truth in self._clips:
            if time.perf_counter() - start > self.limit_s:
                break
            odometry = build_odometry(weights, seed=0, device=program.device)
            m, done, flow = track_with_flow(odometry, frames, truth)
            found[f"track/{name}/ate_percent"] = m.ate_percent
            found[f"track/{name}/rotation_ratio"] = m.rotation_error_ratio
            image = None if flow is None else image_at(frames, flow.timestamp, flow.pixels)
            title = f"{name}, step {step}: ATE {m.ate_percent:.1f} %"
            picture = draw(folder / f"{name}_{step:07d}.png", title, done.result.trajectory, truth, flow, image)
            for logger in trainer.loggers:
                if hasattr(logger.experiment, "add_image"):
                    logger.experiment.add_image(f"track/{name}", picture, step, dataformats="HWC")
        for measure in ("ate_percent", "rotation_ratio"):
            values = [v for k, v in found.items() if k.endswith(measure)]
            found[f"track/{measure}"] = float(np.nanmedian(values)) if not np.isnan(values).all() else float("nan")
        found["track/seconds"] = time.perf_counter() - start
        for logger in trainer.loggers:
            logger.log_metrics(found, step)
        errors = ", ".join(
            f"{name} {found[f'track/{name}/ate_percent']:.2f} %"
            for name, _, _ in self._clips
            if f"track/{name}/ate_percent" in found
        )
        print(f"validation at step {step:,}, ATE in % of the path: {errors or 'none'}", flush=True)

    def _rendered_clips(self) -> list[Clip]:
        clips = []
        for index in range(self.rendered):
            source = rendered_clip(index, self.frames, self.size, self.fps)
            clips.append((f"rendered{index}", list(source), source.groundtruth))
        return clips

    def _real_clips(self) -> list[Clip]:
        clips = []
        for name in self.sequences:
            if (data_root(required=False) / name).is_dir():
                source = open_source(data_root(required=False) / name)
                frames = list(islice(source, self.real_frames))
                truth = source.groundtruth
                if truth is not None:
                    kept = truth.timestamps <= frames[-1].timestamp + 1e-6
                    clips.append((name, frames, Trajectory(truth.timestamps[kept], truth.poses_wc[kept])))
        return clips
