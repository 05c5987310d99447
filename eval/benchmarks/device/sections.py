"""Sections of the benchmark: each yields rows until its time is up. They run in a process of their own."""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import torch

from dvo.core.errors import DvoError
from dvo.core.kernels import CHOICES, VARIABLE, use_device_kernels
from dvo.core.processes import bound
from dvo.core.yaml_files import read_yaml
from dvo.data.frame import Frame
from dvo.models.weights import FOLDER, LoadedWeights, load_weights
from dvo.odometry.load import build_odometry
from dvo.odometry.patch.config import PRESETS
from dvo.odometry.protocol import Odometry, Status
from dvo.synth.sequence import make_sequence
from eval.benchmarks.device.rows import Row, reason_of
from eval.benchmarks.device.waits import waits_of_device, waits_of_stand_in
from eval.benchmarks.kernels import KERNELS, compare
from eval.suites.suite import ROOT

_OUTCOME = re.compile(r"^(tests/\S+::.+?) (PASSED|FAILED|ERROR|SKIPPED)")
_SUMMARY = re.compile(r"^(?:FAILED|ERROR) (tests/\S+::.+?) - (.*)")


@dataclass(frozen=True)
class Setting:
    """What a section is given.

    Attributes:
        device: to measure.
        seconds: that it may take.
        quick: tiny sizes.
        start: clock at its start.
    """

    device: torch.device
    seconds: float
    quick: bool
    start: float

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.start + self.seconds - time.perf_counter()

    def wait(self) -> None:
        """Wait until the device has done everything."""
        getattr(torch, self.device.type).synchronize()  # a module for each kind of device

    def memory_mb(self) -> float:
        """Peak memory, of the device or, on the CPU, of the process."""
        module = getattr(torch, self.device.type)
        if hasattr(module, "max_memory_allocated"):
            return module.max_memory_allocated(self.device) / 2**20
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _cases(section: str, given: Setting, cases: Sequence[tuple[str, Callable[[float], Row]]]) -> Iterator[Row]:
    """Rows of functions of the seconds that they may take; one that fails is a row too, and the next follows."""
    for number, (case, measure) in enumerate(cases):
        if given.left <= 0:
            yield Row(section, case, note="not measured: the time of the section is up")
            continue
        try:
            yield measure(given.left / (len(cases) - number))
        except DvoError as error:
            yield Row(section, case, note=f"left out: {' '.join(str(error).split())}"[:300])
        except Exception as error:  # whatever it is, the others go on
            yield Row(section, case, note=reason_of(error), failed=True)


def tests(given: Setting) -> Iterator[Row]:
    """Tests with the marker ``gpu``: a row for each.

    Args:
        given: device and time.
    """
    command = [sys.executable, "-m", "pytest", "-v", "-n", "0", "-p", "no:cacheprovider", "--color=no"]
    command += ["-m", "gpu and not slow" if given.quick else "gpu", "--device", str(given.device), "tests/gpu"]
    pipe, both = subprocess.PIPE, subprocess.STDOUT
    with subprocess.Popen(bound(command), cwd=ROOT, stdout=pipe, stderr=both, text=True) as process:
        assert process.stdout is not None
        last, seen, before = "", 0, time.perf_counter()
        for line in process.stdout:
            last = line.strip() or last
            if found := _OUTCOME.match(line):
                now, name, seen = time.perf_counter(), found[1].removeprefix("tests/gpu/"), seen + 1
                if found[2] == "PASSED":
                    yield Row("tests", name, now - before, "s")
                elif found[2] == "SKIPPED":
                    yield Row("tests", name, note="skipped")
                before = now
            elif found := _SUMMARY.match(line):
                yield Row("tests", found[1].removeprefix("tests/gpu/"), note=found[2][:300], failed=True)
    if not seen:
        yield Row("tests", "all", note=last[:300], failed=True)


def waits(given: Setting) -> Iterator[Row]:
    """Synchronisations of a frame that the network measures: by the stand-in, and as the device tells them.

    Args:
        given: device and time.
    """
    few = _walk(replace(given, quick=True), count=12 if given.quick else 24)  # the stand-in is slow

    def counted(measure: Callable[[], tuple[float, str]]) -> Callable[[float], Row]:
        def row(_: float) -> Row:
            value, places = measure()
            return Row("waits", case_of[measure], value, "per frame", note=places)

        return row

    def told() -> tuple[float, str]:
        return waits_of_device(lambda: _walk(given, count=12 if given.quick else 60), given.device)

    def stood_in() -> tuple[float, str]:
        return waits_of_stand_in(few)

    case_of = {told: "of the device", stood_in: "of the stand-in"}
    yield from _cases("waits", given, [(name, counted(measure)) for measure, name in case_of.items()])


def kernels(given: Setting) -> Iterator[Row]:
    """Milliseconds of kernels, on one thread where the CPU computes, with their ratio to the PyTorch twins.

    Args:
        given: device and time.
    """

    def one(name: str) -> Callable[[float], Row]:
        def measure(_: float) -> Row:
            with torch.inference_mode():
                size, call = KERNELS[name](torch.Generator().manual_seed(0), given.device)
                kernel, twin, largest = compare(call, 2 if given.quick else 30, given.device)
            note = f"{size}; twin {1e3 * twin:.3g} ms, ratio {twin / kernel:.2f}, difference {largest:.1e}"
            return Row("kernels", name, 1e3 * kernel, "ms", given.memory_mb(), note)

        return measure

    tried = use_device_kernels(torch.zeros(1, device=given.device)) or given.device.type == "cpu"
    if not tried:
        yield Row("kernels", "all", note="left out: no kernels on this device, see the line on the error output")
        return
    yield from _cases("kernels", given, [(name, one(name)) for name in KERNELS])


def presets(given: Setting) -> Iterator[Row]:
    """Frames per second of the tracker with every preset, the weights ``full`` among them.

    Kernels are compiled for sizes of the graph as they come, so the clip is tracked once before it is timed.

    Args:
        given: device and time.
    """
    frames = _walk(given, count=12 if given.quick else 160)
    small = [(f"small, {name}", {"preset": name}) for name in PRESETS]

    def one(case: str, options: dict[str, Any]) -> Callable[[float], Row]:
        def measure(seconds: float) -> Row:
            _speed("presets", case, frames, [_tracker("small", given, 0, options)], seconds / 2, given)
            return _speed("presets", case, frames, [_tracker("small", given, 0, options)], seconds / 2, given)

        return measure

    def full(seconds: float) -> Row:
        if not (FOLDER / "full.safetensors").is_file():
            raise DvoError("no such weights here", file="full")
        return _speed("presets", "full", frames, [_tracker("full", given, 0, {})], seconds, given)

    def plain(seconds: float) -> Row:
        with mock.patch.dict(os.environ, {VARIABLE: CHOICES[1]}):
            return _speed("presets", "small, no kernels", frames, [_tracker("small", given, 0, {})], seconds, given)

    cases = [(case, one(case, options)) for case, options in small]
    yield from _cases("presets", given, [*cases, ("small, no kernels", plain), ("full", full)])


def videos(given: Setting) -> Iterator[Row]:
    """Frames per second of one video, and of many whose trackers take turns with one network.

    Args:
        given: device and time.
    """
    frames = _walk(given, count=12 if given.quick else 120)

    def together(count: int) -> Callable[[float], Row]:
        def measure(seconds: float) -> Row:
            weights = load_weights("small", given.device)
            trackers = [_build(weights, given, seed, {}) for seed in range(count)]
            # Many take long over a frame: half of the frames, so that the timed ones are reached.
            few = frames if count == 1 else frames[: len(frames) // 2]
            return _speed("videos", f"{count} at once", few, trackers, seconds, given)

        return measure

    counts = (1, 2) if given.quick else (1, 16)
    yield from _cases("videos", given, [(f"{count} at once", together(count)) for count in counts])


def training(given: Setting) -> Iterator[Row]:
    """Training steps per second of the small recipe by batch size, clips rendered on the device.

    Args:
        given: device and time.
    """
    sizes = (1, 2) if given.quick else (1, 4, 16, 32)

    def batch(size: int) -> Callable[[float], Row]:
        return lambda seconds: _training_speed(size, seconds, given)

    yield from _cases("training", given, [(f"batch of {size}", batch(size)) for size in sizes])


SECTIONS: dict[str, tuple[float, Callable[[Setting], Iterator[Row]]]] = {
    "tests": (0.2, tests),
    "waits": (0.15, waits),
    "kernels": (0.08, kernels),
    "presets": (0.25, presets),
    "videos": (0.15, videos),
    "training": (0.17, training),
}
"""By name: share of the time, and the section."""


def _walk(given: Setting, count: int) -> list[Frame]:
    """Rendered video; on an accelerator it is rendered there."""
    height, width = (96, 128) if given.quick else (240, 320)
    return list(make_sequence(1, frames=count, height=height, width=width, device=given.device))


def _tracker(weights: str, given: Setting, seed: int, options: dict[str, Any]) -> Odometry:
    return _build(load_weights(weights, given.device), given, seed, options)


def _build(weights: LoadedWeights, given: Setting, seed: int, options: dict[str, Any]) -> Odometry:
    return build_odometry(weights, device=given.device, seed=seed, **options)


def _speed(
    section: str, case: str, frames: list[Frame], trackers: list[Odometry], seconds: float, given: Setting
) -> Row:
    """Frames per second of trackers that take turns, once all of them track; the first third is not timed."""
    end, warm = time.perf_counter() + seconds, len(frames) // 3
    tracked, spent, estimate = 0, 0.0, None
    for number, frame in enumerate(frames):
        given.wait()
        start = time.perf_counter()
        for odometry in trackers:
            estimate = odometry.track(frame)
        given.wait()
        now = time.perf_counter()
        if number >= warm:
            tracked, spent = tracked + len(trackers), spent + now - start
        if now > end and tracked:
            break
    if not tracked:
        return Row(section, case, note="no frame in the time of the case")
    assert estimate is not None
    note = f"{tracked} frames" + ("" if estimate.status is Status.TRACKING else f", {estimate.status.value} at the end")
    return Row(section, case, tracked / spent, "frames/s", given.memory_mb(), note)


def _training_speed(size: int, seconds: float, given: Setting) -> Row:
    from train.data.clips import CurriculumStage, MixedClips
    from train.engine.build import make_program

    warnings.filterwarnings("ignore", module="lightning")
    recipe = read_yaml(ROOT / "configs" / "train" / "small.yaml")
    data = recipe["data"]
    torch.manual_seed(0)
    program = make_program(**{**recipe["model"], "warmup_until": 0.0}).to(given.device)
    program.log_dict = program.log = lambda *_, **__: None  # type: ignore[assignment,method-assign]
    optimizer = program.configure_optimizers()["optimizer"]
    stage = CurriculumStage(0, data["flow_low"], data["flow_high"], [(48, 64) if given.quick else (120, 160)])
    clips = MixedClips(0, [stage], size, frames=4 if given.quick else 8, device=given.device)
    end, steps, spent, rendering = time.perf_counter() + seconds, 0, 0.0, 0.0
    for step in range(2 if given.quick else 21):
        given.wait()
        start = time.perf_counter()
        batch = torch.utils.data.default_collate([clips[step * size + i] for i in range(size)])
        batch = {name: value.to(given.device) for name, value in batch.items()}
        given.wait()
        rendered = time.perf_counter()
        loss = program.training_step(batch, step)
        if loss is not None:
            optimizer.zero_grad()
            loss.backward()
            program.on_before_optimizer_step(optimizer)
            optimizer.step()
        given.wait()
        now = time.perf_counter()
        if step:  # the first builds schedules
            steps, spent, rendering = steps + 1, spent + now - start, rendering + rendered - start
        if now > end and steps:
            break
    note = f"{steps} steps, {size * steps / spent:.1f} clips/s, {100 * rendering / spent:.0f} % of the time rendering"
    return Row("training", f"batch of {size}", steps / spent, "steps/s", given.memory_mb(), note)
