"""Validation while training: the real tracker runs on a few clips with the averaged weights."""

from __future__ import annotations

import copy
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.data.source import open_source
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.odometry.config import TRACKER_PRESETS, TrackerConfig
from dvo.odometry.tracker import PatchOdometry
from train.validation.pictures import draw, image_at, patch_flow
from train.validation.validate import data_root, rendered_clip

Clip = tuple[str, list[Frame], Trajectory]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Whatever runs inside draws from copies of the random states of Python, numpy and torch (CPU)."""
    python, numpy, torch_cpu = random.getstate(), np.random.get_state(), torch.random.get_rng_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        torch.random.set_rng_state(torch_cpu)


class TrackWhileTraining(L.Callback):
    """Every so many steps, tracks rendered clips of the validation seed and, where ``DVO_DATA`` is, real sequences.

    Logs ATE (Sim(3), % of path) and rotation error over rotation for each clip and as medians; writes a picture of each
    clip to ``dirpath/pictures`` and to TensorBoard. Training itself sees nothing of it: no random number is drawn from
    its states, and the time is left out of its timing.

    Args:
        dirpath: folder of the run.
        every: steps between validations.
        rendered: number of rendered clips; frames, size (height, width), fps: of each.
        sequences: names of real sequences under ``DVO_DATA``; missing ones are passed over.
        real_frames: only the first so many frames of each of these.
        limit_s: no further clip is begun after this many seconds.
    """

    def __init__(
        self,
        dirpath: str,
        every: int = 1000,
        rendered: int = 2,
        frames: int = 40,
        size: tuple[int, int] = (120, 160),
        fps: float = 10.0,
        sequences: list[str] | None = None,
        real_frames: int = 40,
        limit_s: float = 60.0,
    ) -> None:
        self.folder, self.every, self.limit_s = Path(dirpath) / "pictures", every, limit_s
        self.rendered, self.frames, self.size, self.fps = rendered, frames, size, fps
        self.sequences, self.real_frames = sequences or [], real_frames
        self._clips: list[Clip] | None = None
        self._last = -1

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._last = trainer.global_step

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        self._perhaps(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.global_step >= trainer.max_steps >= 0:  # not when a person waits for it to stop
            self._perhaps(trainer, pl_module)

    def _perhaps(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        step = trainer.global_step
        if step % self.every or step == self._last:
            return
        self._last = step
        start = time.perf_counter()
        if trainer.is_global_zero:
            with undisturbed():
                self._validate(trainer, pl_module, start)
        trainer.strategy.barrier()
        pl_module.leave_out_of_timing(time.perf_counter() - start)

    def _validate(self, trainer: L.Trainer, program: Any, start: float) -> None:
        step = trainer.global_step
        if self._clips is None:
            self._clips = [*self._rendered_clips(), *self._real_clips()]
            start = time.perf_counter()  # reading and rendering them is paid once
        config = TRACKER_PRESETS.get(program.hparams.model, TrackerConfig())
        model = copy.deepcopy(program.average)
        found: dict[str, float] = {}
        for name, frames, truth in self._clips:
            if time.perf_counter() - start > self.limit_s:
                break
            tracker = PatchOdometry(model, config, seed=0, device=program.device)
            for frame in frames:
                tracker.track(frame)
            result = tracker.finish()
            flow = patch_flow(tracker)
            m = evaluate(result.trajectory, truth, rpe_gap=2)
            found[f"track/{name}/ate_percent"] = m.ate_percent
            found[f"track/{name}/rotation_ratio"] = m.rotation_error_ratio
            image = None if flow is None else image_at(frames, flow.timestamp, config.pixels)
            title = f"{name}, step {step}: ATE {m.ate_percent:.1f} %"
            picture = draw(self.folder / f"{name}_{step:07d}.png", title, result.trajectory, truth, flow, image)
            for logger in trainer.loggers:
                if hasattr(logger.experiment, "add_image"):
                    logger.experiment.add_image(f"track/{name}", picture, step, dataformats="HWC")
        for measure in ("ate_percent", "rotation_ratio"):
            values = [v for k, v in found.items() if k.endswith(measure)]
            found[f"track/{measure}"] = float(np.nanmedian(values)) if not np.isnan(values).all() else float("nan")
        found["track/seconds"] = time.perf_counter() - start
        for logger in trainer.loggers:
            logger.log_metrics(found, step)

    def _rendered_clips(self) -> list[Clip]:
        clips = []
        for index in range(self.rendered):
            source = rendered_clip(index, self.frames, self.size, self.fps)
            clips.append((f"rendered{index}", list(source), source.groundtruth))
        return clips

    def _real_clips(self) -> list[Clip]:
        clips = []
        for name in self.sequences:
            if (data_root() / name).is_dir():
                source = open_source(data_root() / name)
                frames = list(islice(source, self.real_frames))
                truth = source.groundtruth
                if truth is not None:
                    kept = truth.timestamps <= frames[-1].timestamp + 1e-6
                    clips.append((name, frames, Trajectory(truth.timestamps[kept], truth.poses_wc[kept])))
        return clips
