"""The study of V2V: DPVO's loss, V2V's weighting, and weighting with balance, on the same clips.

``python -m train study --config configs/train/study.yaml`` trains every arm with every learning rate and seed, and
writes curves of the validation error and a table. For a seed, the clips, the patches drawn and the weights at the start
are the same for all arms: the differences are paired. A run that is done is not run again; one that was interrupted
goes on from its last checkpoint.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.losses.pose import pose_errors
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import Stage
from dvo.synth.dataset import ClipDataset
from train.data.clips import _From
from train.tasks.patch_vo.module import PatchVOTraining
from train.tasks.patch_vo.objective import LossConfig, clip_terms, truth_of

VALIDATION_SEED = 920_001


@dataclass(frozen=True)
class StudyConfig:
    """What is run.

    Attributes:
        folder: of clips and runs. out: of the table and the curves.
        model, frames, size, updates: preset, and what a clip is (size: height, width in pixels).
        flow: range of the mean induced flow between frames, pixels.
        start_steps: steps that train the flow head alone, shared by all arms of a seed.
        start_rate: their learning rate.
        steps: steps of an arm, one OneCycle.
        rates, seeds: every arm is run with each of both.
        clips: rendered clips a seed, used in turn.
        validate_every, validation_clips: see :func:`validation_error`.
        arms: name to settings of :class:`train.tasks.patch_vo.objective.LossConfig`.
    """

    folder: str = "runs/train/study"
    out: str = "docs/v2v_study"
    model: str = "tiny"
    frames: int = 6
    size: tuple[int, int] = (96, 128)
    flow: tuple[float, float] = (1.0, 10.0)
    updates: int = 6
    start_steps: int = 300
    start_rate: float = 2e-3
    steps: int = 1000
    rates: tuple[float, ...] = (4e-4, 2e-3)
    seeds: tuple[int, ...] = (0, 1, 2)
    clips: int = 500
    validate_every: int = 100
    validation_clips: int = 24
    arms: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {
            "DPVO": {},
            "V2V weighting": {"weighted": True},
            "V2V weighting + balance": {"weighted": True, "balance": "v2v"},
        }
    )

    @classmethod
    def read(cls, file: Path) -> StudyConfig:
        """From YAML.

        Raises:
            DvoError: no such file, or a setting that does not exist.
        """
        import yaml

        if not file.is_file():
            raise DvoError("no such file", file=file, remedy="give configs/train/study.yaml")
        values = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            remedy = "see train.studies.study.StudyConfig"
            raise DvoError("unknown setting", file=file, field=", ".join(unknown), remedy=remedy)
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


class DiskClips(Dataset[dict[str, Tensor]]):
    """Rendered clips that are kept on disk, so that the arms pay for rendering once; index modulo ``count``."""

    def __init__(self, folder: Path, seed: int, count: int, config: StudyConfig) -> None:
        height, width = config.size
        name = f"{seed}_{config.frames}x{height}x{width}_{config.flow[0]:g}-{config.flow[1]:g}"
        self.folder, self.count = folder / name, count
        self.rendered = ClipDataset(
            seed, count, frames=config.frames, height=height, width=width, flow_range=tuple(config.flow)
        )

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        index %= self.count
        file = self.folder / f"{index:06d}.pt"
        if not file.is_file():
            clip = self.rendered[index]
            self.folder.mkdir(parents=True, exist_ok=True)
            torch.save(clip, file.with_suffix(".part"))
            file.with_suffix(".part").rename(file)
        return torch.load(file, weights_only=True)


class StudyClips(L.LightningDataModule):
    """The clips of one seed, one a step, from a position on that the checkpoint keeps."""

    def __init__(self, clips: DiskClips) -> None:
        super().__init__()
        self.clips, self.clips_seen = clips, 0

    def train_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        return DataLoader(self.clips, batch_size=1, sampler=_From(self.clips_seen))

    def state_dict(self) -> dict[str, Any]:
        return {"clips_seen": self.clips_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.clips_seen = int(state_dict["clips_seen"])


@torch.no_grad()
def validation_error(net: PatchVO, clips: DiskClips, stages: list[Stage]) -> dict[str, float]:
    """Means over held-out clips, after the last update: ``pose`` (translation in median depths + rotation in radians,
    the same unweighted measure for all arms), ``rotation_deg``, ``rotation_ratio`` (over true motion, the median),
    ``translation``, ``flow`` (plain, feature pixels)."""
    rows: dict[str, list[float]] = {"pose": [], "rotation_deg": [], "rotation_ratio": [], "translation": [], "flow": []}
    for index in range(clips.count):
        batch = {name: value[None] for name, value in clips[index].items()}
        truth = truth_of(batch, net.config.STRIDE)
        n = batch["images"].shape[1]
        states = list(
            net.unroll(
                batch["images"], batch["intrinsics"], stages, poses_cw=se3.identity(1, n),
                generator=torch.Generator().manual_seed(index),
            )
        )  # fmt: skip
        _, measures = clip_terms(states[-1:], truth, LossConfig())
        errors = pose_errors(states[-1].poses_cw, truth.poses_cw)
        rows["pose"].append(float(errors.translation + errors.rotation))
        for name in ("rotation_deg", "rotation_ratio", "translation", "flow"):
            rows[name].append(float(measures[name]))
    means = {name: sum(values) / len(values) for name, values in rows.items()}
    return means | {"rotation_ratio": float(torch.tensor(rows["rotation_ratio"]).median())}


class Curve(L.Callback):
    """Measures the validation error every so many steps, and once before the first; kept with the checkpoint."""

    def __init__(self, clips: DiskClips, every: int, stages: list[Stage]) -> None:
        self.clips, self.every, self.stages = clips, every, stages
        self.rows: list[dict[str, float]] = []
        self.train_seconds = 0.0
        self._clock = 0.0

    def _measure(self, step: int, program: Any) -> None:
        if not self.rows or self.rows[-1]["step"] < step:
            row = {"step": float(step), "beta": program.beta.value, "rotation_coefficient": program.rotation.value}
            self.rows.append(row | validation_error(program.net, self.clips, self.stages))

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._measure(trainer.global_step, pl_module)

    def on_train_batch_start(self, *_: Any) -> None:
        self._clock = time.process_time()  # of the processor: the machine may do other work

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        self.train_seconds += time.process_time() - self._clock
        if trainer.global_step % self.every == 0:
            self._measure(trainer.global_step, pl_module)

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows, "train_seconds": self.train_seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows, self.train_seconds = state_dict["rows"], state_dict["train_seconds"]


def _train(
    folder: Path, program: PatchVOTraining, clips: DiskClips, steps: int, callbacks: list[L.Callback], save_every: int
) -> None:
    """Train to so many steps, from the last checkpoint of the folder if there is one."""
    # The curve comes before the saver, so that a checkpoint holds the row of its own step.
    saver = ModelCheckpoint(
        folder, filename="last", every_n_train_steps=save_every, save_top_k=1, enable_version_counter=False
    )
    trainer = L.Trainer(
        accelerator="cpu", max_steps=steps, max_epochs=-1, logger=False, enable_progress_bar=False,
        enable_model_summary=False, use_distributed_sampler=False, callbacks=[*callbacks, saver],
    )  # fmt: skip
    last = folder / "last.ckpt"
    trainer.fit(program, StudyClips(clips), ckpt_path=last if last.is_file() else None, weights_only=False)
    trainer.save_checkpoint(last)


def _start_of(seed: int, config: StudyConfig, clips: DiskClips) -> dict[str, Tensor]:
    """Weights that all arms of a seed start from: the flow head trained alone for a while."""
    folder = Path(config.folder) / f"start_seed{seed}"
    done = folder / "done.pt"
    if not done.is_file():
        torch.manual_seed(seed)
        program = PatchVOTraining(
            config.model, seed, config.updates, learning_rate=config.start_rate, cycle=config.start_steps,
            warmup_until=2.0, loss=LossConfig(target=1.0),
        )  # fmt: skip
        if config.start_steps > 0:
            _train(folder, program, clips, config.start_steps, [], 100)
        folder.mkdir(parents=True, exist_ok=True)
        torch.save(program.net.state_dict(), done)
    return torch.load(done, weights_only=True)


def run_arm(arm: str, rate: float, seed: int, config: StudyConfig) -> dict[str, Any]:
    """Train one arm, or read what it gave."""
    name = f"{arm.replace(' ', '_').replace('+', 'and')}_rate{rate:g}_seed{seed}"
    folder = Path(config.folder) / name
    done = folder / "result.json"
    if done.is_file():
        return json.loads(done.read_text(encoding="utf-8"))
    clips = DiskClips(Path(config.folder) / "clips", 31 + seed, config.clips, config)
    held_out = DiskClips(Path(config.folder) / "clips", VALIDATION_SEED, config.validation_clips, config)
    start = _start_of(seed, config, clips)
    loss = LossConfig(**({"pose": 10.0, "flow": 0.1, "target": 0.0} | config.arms[arm]))
    program = PatchVOTraining(
        config.model, seed, config.updates, learning_rate=rate, cycle=config.steps, warmup_until=0.0, loss=loss
    )
    program.net.load_state_dict(start)
    program.average.load_state_dict(start)
    curve = Curve(held_out, config.validate_every, program.stages(config.frames, "joint"))
    _train(folder, program, clips, config.steps, [curve], config.validate_every)
    result = {
        "arm": arm, "rate": rate, "seed": seed, "curve": curve.rows, "skipped": int(program.skipped),
        "recovered": program.recovered, "seconds_a_step": curve.train_seconds / max(config.steps, 1),
    }  # fmt: skip
    done.write_text(json.dumps(result, indent=1), encoding="utf-8")
    return result


def main(arguments: list[str]) -> None:
    """``python -m train study --config FILE [--steps N] [--seeds ...]``."""
    from train.studies.report import write_report

    parser = argparse.ArgumentParser(prog="python -m train study", description=__doc__.split("\n")[0])
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--rehearse", type=int, metavar="STEPS", help="run every arm for so many steps, elsewhere")
    parser.add_argument("--seeds", type=int, nargs="*")
    options = parser.parse_args(arguments)
    config = StudyConfig.read(options.config)
    if options.seeds:
        config = replace(config, seeds=tuple(options.seeds))
    if options.rehearse:
        n = options.rehearse
        config = replace(
            config, folder=f"{config.folder}_rehearsal", out=f"{config.folder}_rehearsal/report", steps=n,
            start_steps=min(n, config.start_steps), validate_every=max(1, n // 3), validation_clips=4,
        )  # fmt: skip
    results = []
    for seed in config.seeds:
        for rate in config.rates:
            for arm in config.arms:
                result = run_arm(arm, rate, seed, config)
                results.append(result)
                last = result["curve"][-1]
                print(
                    f"seed {seed} rate {rate:g} {arm}: pose error {last['pose']:.4f}, rotation error over motion "
                    f"{last['rotation_ratio']:.3f}, {result['seconds_a_step']:.2f} s a step",
                    flush=True,
                )
    for file in write_report(results, config):
        print(file)
