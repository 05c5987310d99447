"""Benchmark of a training step: ``python -m eval.benchmarks.training_step [--repeats 5] [--size 120 160]``.

Prints seconds of a step of ``configs/train/small.yaml`` with ``v2v.yaml`` and ``hard.yaml`` from
``train/state/small.ckpt`` by part, with compiled kernels, with their PyTorch twins, and with kernels and the network in
bfloat16 (``--trainer.precision bf16-mixed``): medians of steps on one clip that take turns, so that a busy machine
slows all. Time is that of the processor, summed over threads; with ``--clock`` that of the clock. The losses of each
after the first steps, from the same state, are printed too.
"""

from __future__ import annotations

import os
import statistics
import warnings
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from dvo.core.allocator import reuse_freed_memory
from dvo.core.command_line import OneLineParser
from dvo.core.kernels import CHOICES, VARIABLE
from dvo.core.yaml_files import read_yaml
from train.data.clips import CurriculumStage, MixedClips
from train.engine.build import make_program
from train.engine.program import TrainingProgram
from train.studies.breakdown import measure

ROOT = Path(__file__).resolve().parents[2]
RECIPES = "small", "v2v", "hard"
STATE = ROOT / "train" / "state" / "small.ckpt"
VARIANTS = {"kernels": (CHOICES[0], False), "twins": (CHOICES[1], False), "bfloat16": (CHOICES[0], True)}
"""Choice of kernels, and whether the network computes in bfloat16, by name."""


def trained_program() -> TrainingProgram:
    """Program of the recipes at the state, before its next step."""
    model: dict[str, Any] = {}
    for name in RECIPES:
        model |= read_yaml(ROOT / "configs" / "train" / f"{name}.yaml")["model"]
    state = torch.load(STATE, map_location="cpu", weights_only=True)
    program = make_program(**model)
    program.load_state_dict(state["state_dict"])
    program.task.load_state_dict(state["training"])
    return program


class Losses:
    """Steps of a program, perhaps with automatic mixed precision, whose losses are kept."""

    def __init__(self, program: TrainingProgram, half: bool) -> None:
        self.program, self.half, self.values = program, half, list[float]()
        self._step = program.training_step
        program.training_step = self.step  # type: ignore[method-assign]

    def step(self, batch: dict[str, Tensor], index: int) -> Tensor | None:
        """A step of the program."""
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            loss = self._step(batch, index)
        self.values.append(float("nan") if loss is None else float(loss.detach()))
        return loss


def compare(clip: dict[str, Tensor], repeats: int, processor: bool) -> tuple[dict[str, dict[str, float]], list[Losses]]:
    """Median seconds by part with each of :data:`VARIANTS`, and their losses.

    Args:
        clip: to train on.
        repeats: steps in the median, after one that does not count.
        processor: time of the processor instead of the clock.
    """
    runs = {variant: Losses(trained_program(), half) for variant, (_, half) in VARIANTS.items()}
    found: dict[str, list[dict[str, float]]] = {variant: [] for variant in VARIANTS}
    for _ in range(1 + repeats):
        for variant, run in runs.items():
            with mock.patch.dict(os.environ, {VARIABLE: VARIANTS[variant][0]}):
                found[variant].append(measure(run.program, [clip], 1, 1, warm=0, processor=processor))  # type: ignore[arg-type]
    names = dict.fromkeys(name for parts in found.values() for name in parts[-1] if name != "render")
    medians = {
        variant: {name: statistics.median(x.get(name, 0.0) for x in parts[1:]) for name in names}
        for variant, parts in found.items()
    }
    return medians, list(runs.values())


def main() -> None:
    """Run the benchmark and print its table."""
    parser = OneLineParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="(%(default)s)")
    parser.add_argument("--size", type=int, nargs=2, default=(120, 160), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--clock", action="store_true", help="time of the clock")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", module="lightning")
    reuse_freed_memory()
    torch.set_num_threads(options.threads)
    clip = MixedClips(0, [CurriculumStage(0, 1.0, 14.0, [tuple(options.size)])], 1)[0]
    medians, runs = compare(clip, options.repeats, not options.clock)
    kernels, twins, half = medians.values()
    print(f"{options.size[1]}x{options.size[0]}, {options.threads} thread(s), medians of {options.repeats} steps")
    print(f"{'':32s}{'kernels':>9s}{'twins':>9s}{'ratio':>8s}{'bfloat16':>10s}{'ratio':>8s}")
    for name in kernels:
        own, twin, other = (part[name] for part in (kernels, twins, half))
        by_twin = [x / twin if twin else float("nan") for x in (own, other)]
        print(f"{name:32s}{own:7.3f} s{twin:7.3f} s{by_twin[0]:8.2f}{other:8.3f} s{by_twin[1]:8.2f}")
    values = zip(*(run.values for run in runs), strict=True)
    print("losses: " + ", ".join(" / ".join(f"{x:.5f}" for x in step) for step in values))


if __name__ == "__main__":
    main()
