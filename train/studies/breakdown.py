"""Seconds of a training step of ``patch_vo`` by part: ``python -m train profile [--model small] [--steps 5]``."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch

import dvo.models.step as step_module
import train.tasks.patch_vo.objective as objective
from dvo.ba.layer import edgewise
from dvo.ba.layer.step import GaussNewtonStep
from dvo.core.command_line import OneLineParser
from dvo.nets.correlation import correlation
from dvo.nets.patch.patchifier import Patchifier
from dvo.nets.update.update import Update
from train.data.clips import CurriculumStage, MixedClips
from train.engine.build import make_program
from train.engine.program import TrainingProgram

FORWARD: tuple[tuple[str, Any, str], ...] = (
    ("encoder", Patchifier, "encode"),
    ("correlation volume", correlation.CorrelationVolume, "__init__"),
    ("correlation look-up", correlation.CorrelationVolume, "lookup"),
    ("update operator", Update, "forward"),
    ("bundle adjustment", step_module, "dense_solution"),
    ("reprojection", step_module, "reproject"),
)
LOSS: tuple[tuple[str, Any, str], ...] = (
    ("ground truth of the flow", objective, "true_reprojection"),
    ("flow errors", objective, "flow_error"),
    ("pose errors", objective, "pose_errors"),
)
BACKWARD: tuple[tuple[str, Any, str], ...] = (
    ("correlation look-up, backward", correlation._Lookup, "backward"),
    ("correlation volume, backward", correlation._Source, "backward"),
    ("bundle adjustment, backward", GaussNewtonStep, "backward"),
    ("bundle adjustment, backward", edgewise._Recorded, "backward"),
)


class Stopwatch:
    """Seconds by name, of the clock or of the processor. A part that runs inside another one counts in both."""

    def __init__(self, device: torch.device, processor: bool = False) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.device, self.processor = device, processor

    def _now(self) -> float:
        if self.processor:
            return time.process_time()
        getattr(torch, self.device.type).synchronize()  # a module for each kind of device
        return time.perf_counter()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Add the time of the block to a part."""
        start = self._now()
        try:
            yield
        finally:
            self.seconds[name] += self._now() - start

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function so that its time counts."""

        @functools.wraps(function)
        def run(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return function(*args, **kwargs)

        return run


def measure(
    program: TrainingProgram, clips: MixedClips, batch_size: int, steps: int, warm: int = 2, processor: bool = False
) -> dict[str, float]:
    """Mean seconds a step by part.

    Args:
        program: of the task ``patch_vo``.
        clips: to train on.
        batch_size: clips a step.
        steps: steps in the mean.
        warm: steps before them that do not count.
        processor: time of the processor instead of the clock.

    Returns:
        seconds by part; ``step`` is everything but rendering.
    """
    watch = Stopwatch(program.device, processor)
    optimizer = program.configure_optimizers()["optimizer"]
    program.log_dict = program.log = lambda *a, **k: None  # type: ignore[method-assign, assignment]
    with ExitStack() as patches:
        for name, owner, attribute in (*FORWARD, *LOSS, *BACKWARD):
            raw = owner.__dict__[attribute]
            static = isinstance(raw, staticmethod)
            timed = watch.timed(name, raw.__func__ if static else raw)
            patches.enter_context(mock.patch.object(owner, attribute, staticmethod(timed) if static else timed))
        for step in range(warm + steps):
            if step == warm:
                watch.seconds.clear()
            with watch.part("render"):
                items = [clips[step * batch_size + i] for i in range(batch_size)]
                batch = torch.utils.data.default_collate(items)
            batch = {name: value.to(program.device) for name, value in batch.items()}
            with watch.part("step"):
                with watch.part("forward and loss"):
                    loss = program.training_step(batch, step)
                assert loss is not None
                with watch.part("backward"):
                    loss.backward()
                with watch.part("optimiser"):
                    torch.nn.utils.clip_grad_norm_(program.net.parameters(), program.settings.clip)
                    optimizer.step()
                    optimizer.zero_grad()
    return {name: seconds / steps for name, seconds in watch.seconds.items()}


def table(seconds: dict[str, float]) -> str:
    """Text of the result."""
    step = seconds["step"]
    forward = [name for name, _, _ in FORWARD]
    loss = [name for name, _, _ in LOSS]
    backward = list(dict.fromkeys(name for name, _, _ in BACKWARD))
    # Reprojection is called by the objective under its own name, so nothing here is counted twice.
    rest = seconds["forward and loss"] - sum(seconds.get(n, 0.0) for n in (*forward, *loss))
    behind = seconds["backward"] - sum(seconds.get(n, 0.0) for n in backward)
    rows = [(n, seconds.get(n, 0.0)) for n in forward] + [(n, seconds.get(n, 0.0)) for n in loss]
    rows += [("other forward", rest)] + [(n, seconds.get(n, 0.0)) for n in backward]
    rows += [("update operator, encoder, losses, backward", behind), ("optimiser", seconds["optimiser"])]
    lines = [f"{name:44s} {value:7.3f} s {100 * value / step:5.1f} %" for name, value in rows]
    lines.append(f"{'step':44s} {step:7.3f} s")
    lines.append(f"{'render (in its own process in training)':44s} {seconds['render']:7.3f} s")
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """``python -m train profile``; prints the table."""
    parser = OneLineParser(prog="python -m train profile", description=__doc__)
    parser.add_argument("--model", default="small")
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(120, 160), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--updates", type=int, default=10)
    parser.add_argument("--initial", type=int, default=4, help="frames of the first graph; 0: all")
    parser.add_argument("--mode", choices=("joint", "structure", "flow"), default="joint")
    parser.add_argument("--weighted", action="store_true")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cpu-time", action="store_true", help="processor seconds: for a machine that does other work")
    options = parser.parse_args(arguments)
    from dvo.core.allocator import reuse_freed_memory

    reuse_freed_memory()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    loss = {"pose": 10.0, "flow": 0.3, "target": 0.5, "weighted": options.weighted}
    program = make_program(
        "patch_vo", model=options.model, updates=options.updates, initial=options.initial or None,
        warmup_mode=options.mode, warmup_until=0.0 if options.mode == "joint" else 2.0, loss=loss,
    ).to(options.device)  # fmt: skip
    stage = CurriculumStage(0, 1.0, 14.0, [tuple(options.size)])
    clips = MixedClips(0, [stage], options.batch, frames=options.frames)
    seconds = measure(program, clips, options.batch, options.steps, processor=options.cpu_time)
    print(
        f"{options.model}, {options.batch} clip(s) of {options.frames} frames {options.size[1]}x{options.size[0]}, "
        f"{options.updates} updates, mode {options.mode}, {options.threads} thread(s) on {options.device}; "
        f"mean of {options.steps} steps{', processor time' if options.cpu_time else ''}"
    )
    print(table(seconds))
