"""Speed of the renderer, alone and relative to a training step.

``python -m eval.benchmarks.rendering [--frames 8] [--clips 5] [--steps 3] [--threads 1]``

Prints frames per second without sensor effects at three sizes, on the CPU and on the accelerator if there is one, for a
scene of each family; then the time to generate one training clip and that of one training step of the small
configuration (configs/train/small.yaml), with the same number of threads, one after the other. In training a worker
process renders on a core of its own, so training waits only if the ratio exceeds 1. On the CPU, time is processor time
of this process (summed over threads), so that other load of the machine does not affect the results.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dvo.core.allocator import reuse_freed_memory
from dvo.core.command_line import OneLineParser
from dvo.core.yaml_files import read_yaml
from dvo.synth import random_path, random_scene, render
from dvo.synth.clip import make_clip
from dvo.synth.scenes.families import SHARES
from dvo.synth.textures.texture import texture_pool

SIZES = ((120, 160), (240, 320), (480, 640))
RECIPE = Path(__file__).resolve().parents[2] / "configs" / "train" / "small.yaml"


def frames_per_second(device: torch.device, frames: int) -> list[tuple[str, list[float]]]:
    """Rendering speed for each family of scenes.

    Args:
        device: to render on.
        frames: number of frames rendered together.

    Returns:
        For each family, and last for their mean time, the frames per second at each of :data:`SIZES`.
    """
    rows, seconds = [], np.zeros((len(SHARES), len(SIZES)))
    for i, family in enumerate(SHARES):
        scene = random_scene(0, family, pool=texture_pool(0))
        poses = random_path(scene, 0, "handheld").scaled(0.3).poses_wc(np.arange(frames) / 20)
        for j, (height, width) in enumerate(SIZES):
            k = np.array([0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2])
            clock = time.process_time if device.type == "cpu" else time.perf_counter
            for timed in (False, True):  # the first run fills caches, and copies textures to the accelerator
                start = clock()
                render(scene, poses, k, height, width, device=device, coordinates=False)
                if device.type != "cpu":
                    torch.accelerator.synchronize(device)
                if timed:
                    seconds[i, j] = (clock() - start) / frames
        rows.append((family, (1 / seconds[i]).tolist()))
    rows.append(("mean", (1 / seconds.mean(0)).tolist()))
    return rows


def clip_seconds(count: int, recipe: dict[str, Any]) -> tuple[float, list[dict[str, torch.Tensor]]]:
    """Time to generate a training clip: planning, scene, rendering and sensor effects.

    Args:
        count: number of clips.
        recipe: training configuration.

    Returns:
        Mean processor time, seconds, and the clips as training batches.
    """
    data = recipe["data"]
    options = {"frames": data.get("frames", 8), "flow_range": (data["flow_low"], data["flow_high"])}
    make_clip(0, 2**20, **options)  # textures are generated on first use, which is no part of a running training
    batches = []
    start = time.process_time()
    for index in range(count):
        height, width = data["sizes"][index % len(data["sizes"])]
        clip = make_clip(0, index, height=height, width=width, **options)
        names = ("images", "depth", "poses_cw", "intrinsics")
        batches.append({name: getattr(clip, name)[None] for name in names})
    return (time.process_time() - start) / count, batches


def step_seconds(count: int, recipe: dict[str, Any], batches: list[dict[str, torch.Tensor]]) -> float:
    """Time of a training step with bundle adjustment: loss, backward, clipping, optimiser.

    Args:
        count: number of timed steps.
        recipe: training configuration.
        batches: training batches, used in turn.

    Returns:
        Mean processor time, seconds.
    """
    from train.engine.build import make_program

    module = make_program(**{**recipe["model"], "warmup_until": 0.0})
    module.log_dict = module.log = lambda *_, **__: None  # type: ignore[assignment,method-assign]
    optimizer = module.configure_optimizers()["optimizer"]
    spent = []
    for index in range(count + 1):
        start = time.process_time()
        loss = module.training_step(batches[index % len(batches)], index)
        if loss is not None:
            optimizer.zero_grad()
            loss.backward()
            module.on_before_optimizer_step(optimizer)
            optimizer.step()
        spent.append(time.process_time() - start)
    return float(np.mean(spent[1:]))  # without the first one, which builds schedules


def main() -> None:
    """Run the benchmark and print its tables."""
    parser = OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=8, help="frames rendered together")
    parser.add_argument("--clips", type=int, default=5)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    warnings.filterwarnings("ignore", module="lightning")
    reuse_freed_memory()
    torch.set_num_threads(options.threads)
    devices = [torch.device("cpu")]
    accelerator = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
    if accelerator is not None:
        devices.append(torch.device(accelerator.type))
    for device in devices:
        print(f"frames/s on {device}, {options.threads} threads" if device.type == "cpu" else f"frames/s on {device}")
        print(f"{'family':<10}" + "".join(f"{f'{width}x{height}':>10}" for height, width in SIZES))
        for name, rates in frames_per_second(device, options.frames):
            print(f"{name:<10}" + "".join(f"{rate:>10.1f}" for rate in rates))
    recipe = read_yaml(RECIPE)
    clip, batches = clip_seconds(options.clips, recipe)
    step = step_seconds(options.steps, recipe, batches)
    print(f"one training clip {clip:.2f} s, one training step {step:.2f} s: rendering / training = {clip / step:.2f}")


if __name__ == "__main__":
    main()
