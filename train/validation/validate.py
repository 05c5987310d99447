"""Track the real validation sequences with a training checkpoint or a weights file.

These sequences choose weights and settings; they are never a test.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.data.source import open_source
from dvo.data.trajectory import Trajectory
from dvo.metrics import Metrics, evaluate
from dvo.models.weights import load_weights
from dvo.odometry.config import TRACKER_PRESETS, TrackerConfig
from dvo.odometry.protocol import Odometry
from dvo.odometry.tracker import PatchOdometry
from dvo.synth.sequence import SyntheticSequence, make_sequence
from train.engine.export import averaged_model

VALIDATION_SEED = 900_001  # training seeds are small numbers
SEQUENCES = ("kitti00_120", "7scenes_redkitchen_400", "tartanair_v1_60", "tum_fr1_rpy_60")


def data_root() -> Path:
    """Where the sequences lie: ``DVO_DATA``, or ``../shared/data`` beside the checkout."""
    default = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("DVO_DATA", default))


def track_sequence(odometry: Odometry, frames: Iterable[Frame], truth: Trajectory | None) -> tuple[Metrics, float, int]:
    """Metrics (Sim(3); relative errors over a gap of 2 frames), frames per second, and frames lost."""
    start = time.perf_counter()
    for frame in frames:
        odometry.track(frame)
    result = odometry.finish()
    rate = result.frames_read / (time.perf_counter() - start)
    assert truth is not None
    return evaluate(result.trajectory, truth, rpe_gap=2), rate, result.frames_lost


def rendered_clip(index: int, frames: int, size: tuple[int, int], fps: float) -> SyntheticSequence:
    """A rendered validation clip: of a scene that training cannot draw. ``size`` is height, width."""
    height, width = size
    return make_sequence(VALIDATION_SEED + index, frames=frames, height=height, width=width, fps=fps, apart=True)


def main(arguments: list[str]) -> None:
    """``python -m train validate CHECKPOINT|WEIGHTS``."""
    parser = argparse.ArgumentParser(prog="python -m train validate", description=__doc__)
    parser.add_argument("weights", help="a training checkpoint (.ckpt, .pt), or weights by name or file")
    parser.add_argument("--frames", type=int, help="only the first frames of each sequence")
    parser.add_argument("--rendered", type=int, default=0, help="number of rendered validation clips")
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

    def ready(seed: int) -> Odometry:
        return PatchOdometry(model, config, seed=seed, device=options.device)

    for name in options.sequences:
        for seed in range(options.seeds):
            source = open_source(data_root() / name)
            m, rate, lost = track_sequence(ready(seed), islice(source, options.frames), source.groundtruth)
            print(
                f"{name:24s} seed {seed} ATE {m.ate_percent:7.2f} % of {m.path_length:6.2f} m  RPE rot "
                f"{m.rpe_rot_deg:6.3f} deg  rotation error/motion {m.rotation_error_ratio:5.3f}  scale drift "
                f"{m.scale_drift:+.2f}  lost {lost}  {rate:5.1f} fps",
                flush=True,
            )
    found = []
    for index in range(options.rendered):
        source = rendered_clip(index, 60, (240, 320), 15.0)
        m, _, _ = track_sequence(ready(0), source, source.groundtruth)
        found.append((m.ate_percent, m.rotation_error_ratio))
        print(f"rendered clip {index}: ATE {m.ate_percent:.2f} %, rotation error/motion {m.rotation_error_ratio:.3f}")
    if found:
        print("rendered, median: ATE {:.2f} %, rotation error/motion {:.3f}".format(*np.nanmedian(found, axis=0)))
