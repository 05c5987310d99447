"""Readers of settings: of the tracker, of suites and systems of the evaluation, of training and studies."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.settings import parse_settings, read_settings
from tests.fuzz.mutations import mutate_folder, mutate_text
from tests.fuzz.readers_data import lines
from tests.fuzz.target import CleanExit, Target, require

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = ["patches: 24", "pixels: 76800", "motion_damping: 0.5", "lost_confidence: 0.01", "updates: 1"]
SUITE = [
    "name: mine", "label: a suite of one's own", "alignment: sim3", "rpe_gap: 2", "stride: 1", "lost_below: 0.5",
    "time_limit: 1800", "download: https://example.org", "sequences:", "  - name: a", "    path: a/b",
    "    judged_by: ate_percent", "    about: indoors", "    calib: calib.txt", "  - {name: b, path: c, times: t.txt}",
    "  - {name: d, path: e, groundtruth: g.txt, judged_by: rpe_rot_deg}",
]  # fmt: skip
SYSTEMS = [
    "klt-pnp+corners=400", "dvo-small+patches=48+motion_damping=0.3", "null", "keyframe", "dvo:weights.safetensors",
    "package.module:Class", "file.py:Class+a=[1, 2]+b={c: d}", "monoslam+x=2024-01-01",
]  # fmt: skip
TRAINING = [
    "task: patch_vo", "seed_everything: 0", "trainer:", "  accelerator: cpu", "  devices: 1", "  max_epochs: -1",
    "  max_steps: 1", "  logger: false", "  enable_checkpointing: false", "  enable_progress_bar: false",
    "model:", "  model: tiny", "  learning_rate: 4.0e-4", "  initial: 4",
    "  loss: {pose: 10.0, flow: 0.3, target: 0.5}", "  augmentation: {colour: 0.0, zoom: 0.0, exposure: 0.3}",
    "data:", "  batch_size: 1", "  sizes: [[120, 160], [96, 200]]", "  flow_low: 1.0", "  flow_high: 14.0",
]  # fmt: skip


def _settings(folder: Path, random: np.random.Generator | None) -> None:
    from dvo.odometry.patch.config import TrackerConfig

    TrackerConfig.from_dict(read_settings(folder / "settings.yaml"))


def _items(folder: Path, random: np.random.Generator | None) -> None:
    from dvo.odometry.patch.config import TrackerConfig

    text = (folder / "set.items").read_bytes().decode("utf-8", errors="surrogateescape")
    TrackerConfig.from_dict(parse_settings(text[:10_000_000].splitlines()))


def _suite(folder: Path, random: np.random.Generator | None) -> None:
    from eval.suites.selection import load_suites, settle, suite_from

    for suite in load_suites([str(folder / "suite.yaml")], stride=None):
        for sequence in suite.sequences:
            settle(suite, sequence, folder)
            for value in (sequence.calib, sequence.times, sequence.groundtruth):
                require(value is None or isinstance(value, str), "file that is no text")
            require(isinstance(sequence.name, str) and isinstance(sequence.about, str), "name that is no text")
        require(suite_from(json.loads(json.dumps(asdict(suite)))) == suite, "suite that is another one after JSON")
        require(type(suite.stride) is int and suite.stride >= 1, "stride")
        require(type(suite.rpe_gap) is int and suite.rpe_gap >= 1, "rpe_gap")
        require(0 <= suite.lost_below <= 1, "lost_below")
        require(suite.time_limit > 0, "time_limit")
        require(isinstance(suite.name, str) and isinstance(suite.label, str), "label that is no text")


def _system(folder: Path, random: np.random.Generator | None) -> None:
    from eval.systems.registry import find_system

    text = (folder / "systems.items").read_bytes().decode("utf-8", errors="surrogateescape")
    rows = text[:1_000_000].splitlines()
    if not rows:
        raise CleanExit("no systems")
    for row in rows[:20]:
        system = find_system(row)
        require(isinstance(system.settings, dict), "settings that are no table")


def _fit(folder: Path, random: np.random.Generator | None) -> None:
    """Everything of ``python -m train fit`` up to the first step."""
    from lightning.pytorch.cli import LightningCLI

    from train.engine.cli import train

    LightningCLI._run_subcommand = lambda self, subcommand: None
    sys.argv = ["train", "fit", "--config", str(folder / "train.yaml")]
    try:
        train()
    except SystemExit as error:
        if error.code == 2:  # jsonargparse prints one message
            raise CleanExit("refused by the command line") from None
        raise


def _study(folder: Path, random: np.random.Generator | None) -> None:
    from train.studies.config import StudyConfig

    config = StudyConfig.read(folder / "study.yaml")
    require(type(config.steps) is int and all(type(seed) is int for seed in config.seeds), "numbers of a study")
    require(all(isinstance(arm, dict) for arm in config.arms.values()), "arm that is no table")


def _write(folder: Path, name: str, rows: list[str]) -> None:
    lines(folder / name, rows)


def _copy(folder: Path, name: str, source: Path) -> None:
    (folder / name).write_bytes(source.read_bytes())


def _one(name: str, file: str, rows: list[str], read: Any, *modules: str) -> Target:
    mutate = mutate_text if file.endswith(".items") else mutate_folder
    write = partial(_write, name=file, rows=rows)
    return Target(name, write, read, mutate, ("yaml", "dvo.core.settings", *modules))


TARGETS = (
    _one("settings_yaml", "settings.yaml", SETTINGS, _settings, "dvo.odometry.patch.config"),
    _one("settings_set", "set.items", [row.replace(": ", "=") for row in SETTINGS], _items,
    "dvo.odometry.patch.config"), _one("eval_suite", "suite.yaml", SUITE, _suite, "eval.suites.selection"),
    _one("eval_system", "systems.items", SYSTEMS, _system, "eval.systems.registry", "dvo.models.weights"),
    _one("train_fit", "train.yaml", TRAINING, _fit, "train.engine.cli", "train.tasks.patch_vo.task",
         "train.engine.callbacks", "train.data.clips"),
    Target("train_study", partial(_copy, name="study.yaml", source=ROOT / "configs" / "train" / "study.yaml"), _study,
           modules=("yaml", "train.studies.config")),
)  # fmt: skip
