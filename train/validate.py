"""Track the real validation sequences with a training checkpoint or a weights file.

These sequences choose weights and settings; they are never a test.
"""

from __future__ import annotations

import argparse
import os
import time
from itertools import islice
from pathlib import Path

import torch

from dvo.data.source import open_source
from dvo.metrics import Metrics, evaluate
from dvo.nets.patch_vo import PatchVO
from dvo.nets.weights import load_weights
from dvo.odometry.config import TRACKER_PRESETS, TrackerConfig
from dvo.odometry.tracker import PatchOdometry
from train.export import averaged_model

SEQUENCES = ("kitti00_120", "7scenes_redkitchen_400", "tartanair_v1_60", "tum_fr1_rpy_60")


def data_root() -> Path:
    """Where the sequences lie: ``DVO_DATA``, or ``../shared/data`` beside the checkout."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("DVO_DATA", default))


def track_sequence(
    model: PatchVO, config: TrackerConfig, path: Path, seed: int, frames: int | None, device: str
) -> tuple[Metrics, float, int]:
    """Metrics (Sim(3); relative errors over a gap of 2 frames), frames per second, and frames lost."""
    source = open_source(path)
    odometry = PatchOdometry(model, config, seed=seed, device=device)
    start = time.perf_counter()
    for frame in islice(source, frames):
        odometry.track(frame)
    result = odometry.finish()
    rate = result.frames_read / (time.perf_counter() - start)
    assert source.groundtruth is not None
    return evaluate(result.trajectory, source.groundtruth, rpe_gap=2), rate, result.frames_lost


def main(arguments: list[str]) -> None:
    """``python -m train validate CHECKPOINT|WEIGHTS``."""
    parser = argparse.ArgumentParser(prog="python -m train validate", description=__doc__)
    parser.add_argument("weights", help="a training checkpoint (.ckpt, .pt), or weights by name or file")
    parser.add_argument("--frames", type=int, help="only the first frames of each sequence")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--sequences", nargs="*", default=SEQUENCES)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="tracker settings to try")
    options = parser.parse_args(arguments)
    if Path(options.weights).suffix in (".ckpt", ".pt"):
        model, facts = averaged_model(Path(options.weights))
        preset = str(facts["preset"])
        print(facts)
    else:
        loaded = load_weights(options.weights)
        model, preset = loaded.model, loaded.preset
    settings = dict(TRACKER_PRESETS[preset].__dict__)
    for item in options.set:
        name, _, value = item.partition("=")
        settings[name] = type(settings[name])(float(value))
    config = TrackerConfig.from_dict(settings)
    torch.set_grad_enabled(False)
    for name in options.sequences:
        for seed in range(options.seeds):
            m, rate, lost = track_sequence(model, config, data_root() / name, seed, options.frames, options.device)
            print(
                f"{name:24s} seed {seed} ATE {m.ate_percent:7.2f} % of {m.path_length:6.2f} m  RPE rot "
                f"{m.rpe_rot_deg:6.3f} deg  rotation error/motion {m.rotation_error_ratio:5.3f}  scale drift "
                f"{m.scale_drift:+.2f}  lost {lost}  {rate:5.1f} fps",
                flush=True,
            )
