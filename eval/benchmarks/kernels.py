"""Benchmark of compiled kernels and their twins: ``python -m eval.benchmarks.kernels [--only correlation]``.

Prints for each kernel a line: size, milliseconds of the kernel and of its PyTorch twin on one thread (medians of
``--repeats`` runs that take turns, so that a busy machine slows both), the ratio, and the largest difference of the
results. The lines of ``bfloat16`` and ``int8`` have a part of the network in that precision, and in float32 in place of
the twin.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from unittest import mock

import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.options import BAOptions
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.command_line import OneLineParser
from dvo.core.kernels import CHOICES, VARIABLE
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import full_graph
from dvo.nets.alignment.alignment import align_patches
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.correlation.edge_correlation import EdgeCorrelation, round_channels
from dvo.nets.patch.config import preset
from dvo.nets.patch.encoder import normalise
from dvo.nets.patch.patchifier import normalise_images
from dvo.nets.patch.selection import score_at

Call = Callable[[], Tensor]
CPU = torch.device("cpu")


def edge_correlation(
    generator: torch.Generator, device: torch.device, scale: int, dtype: torch.dtype = torch.float32
) -> tuple[str, Call]:
    """Look-up of the edges of a window at one level of 320x240 video.

    Args:
        generator: of the input.
        device: to compute on.
        scale: of the level.
        dtype: of the maps.
    """
    edges, patches, frames, channels, height, width = 720, 192, 9, 64, 60, 80
    level = EdgeCorrelation(scale, radius=3, device=device, dtype=dtype)
    for slot in range(frames):
        level.keep_map(slot, torch.randn(channels, height // scale, width // scale, generator=generator).to(device))
    features = torch.randn(patches, 9, channels, generator=generator)
    kk = torch.randint(patches, (edges,), generator=generator)
    slots = torch.randint(frames, (edges,), generator=generator)
    ticks = torch.arange(3.0)
    patch = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1)
    coords = torch.rand(edges, 1, 1, 2, generator=generator) * torch.tensor([width, height]) + 1.05 * patch
    given = [x.to(device) for x in (coords, features, kk, slots)]
    if dtype == torch.uint8:
        given[1], *numbers = round_channels(given[1])
        given.append(torch.stack(numbers, -1))
    return f"{edges} edges, {channels} channels", lambda: level.lookup(*given)


def alignment(generator: torch.Generator, device: torch.device) -> tuple[str, Call]:
    """Alignment of the edges that leave a window."""
    edges, frames, height, width = 240, 8, 240, 320
    noise = torch.rand(frames, 1, height // 4, width // 4, generator=generator) * 255
    images = torch.nn.functional.interpolate(noise, (height, width), mode="bicubic")[:, 0].contiguous()
    source = torch.randint(frames, (edges,), generator=generator)
    centres = torch.rand(edges, 2, generator=generator) * torch.tensor([width, height])
    start = centres + torch.rand(edges, 2, generator=generator)
    warps = torch.eye(2) + 0.1 * torch.rand(edges, 2, 2, generator=generator)
    images, source, centres, start, warps = (x.to(device) for x in (images, source, centres, start, warps))
    return f"{edges} edges", lambda: align_patches(images, source, source, centres, start, warps).positions


def normalisation(generator: torch.Generator, device: torch.device) -> tuple[str, Call]:
    """Normalisation and rectifier behind a convolution of the encoder, at half of 320x240."""
    x, skip = (torch.randn(1, 120, 160, 16, generator=generator).permute(0, 3, 1, 2).to(device) for _ in range(2))
    return "16 channels, 160x120", lambda: normalise(x.clone(), torch.nn.InstanceNorm2d(16), skip=skip)


def scores(generator: torch.Generator, device: torch.device) -> tuple[str, Call]:
    """Candidates of the patches of a frame."""
    image = torch.randint(0, 256, (1, 1, 240, 320, 3), generator=generator, dtype=torch.uint8).permute(0, 1, 4, 2, 3)
    places = torch.rand(1, 1, 96, 2, generator=generator) * torch.tensor([80.0, 60.0])
    image, points = image.to(device), places.long().to(device)
    return "96 positions, 320x240", lambda: score_at(image, points)


def update(generator: torch.Generator, device: torch.device) -> tuple[str, Call]:
    """Update operator, of float32 on the CPU."""
    return of_update(generator, "float32")


def of_update(generator: torch.Generator, precision: str) -> tuple[str, Call]:
    """Update operator of the network ``small``, untrained, on the edges of a window, in one precision.

    Args:
        generator: of the input, and of the network the generator of torch.
        precision: of the network and of the correlation.
    """
    config, graph = preset("small"), full_graph(frames=9, patches=24, self_edges=False)
    model = PatchVO(config).eval()
    model = {"float32": lambda: model, "bfloat16": model.in_bfloat16, "int8": model.in_int8}[precision]()
    state = torch.randn(1, len(graph), config.hidden_channels, generator=generator)
    channels = config.correlation_channels // len(config.pyramid)
    shape = (1, len(graph), channels)
    levels = [torch.randn(shape, generator=generator).to(model.precision) for _ in config.pyramid]
    correlation = Correlation(levels, order="pixels_first")
    return f"{len(graph)} edges", lambda: model.update(state, state, correlation, graph)[1]


def window(generator: torch.Generator, device: torch.device) -> PatchProblem:
    """Window of a tracker, a batch of one."""
    frames, per_frame = 9, 24
    count = frames * per_frame
    poses = torch.cat([0.05 * torch.rand(1, frames, 3, generator=generator), torch.zeros(1, frames, 3)], 2)
    poses = torch.cat([poses, torch.ones(1, frames, 1)], 2)
    place = torch.rand(1, count, 2, 1, 1, generator=generator) * torch.tensor([80.0, 60.0])[:, None, None]
    patches = torch.cat([place, 0.5 + torch.rand(1, count, 1, 1, 1, generator=generator)], 2).expand(-1, -1, -1, 3, 3)
    intrinsics = torch.tensor([60.0, 60.0, 40.0, 30.0]).expand(1, frames, 4).contiguous()
    kk, jj = torch.arange(count).repeat_interleave(frames), torch.arange(frames).repeat(count)
    targets = patches[:, kk, :2, 1, 1] + torch.rand(1, len(kk), 2, generator=generator)
    weights = torch.rand(1, len(kk), 2, generator=generator)
    poses, patches, intrinsics = (x.to(device) for x in (poses, patches.contiguous(), intrinsics))
    targets, weights, ii, jj, kk = (x.to(device) for x in (targets, weights, kk // per_frame, jj, kk))
    return PatchProblem(poses, patches, intrinsics, targets, weights, ii, jj, kk)


def window_solver(generator: torch.Generator, device: torch.device) -> tuple[str, Call]:
    """Two Gauss-Newton steps on a window."""
    problem = window(generator, device)
    options = BAOptions(fixed=2, bounds=(80, 60), kernel=Kernel("cauchy", 0.3), check=False)
    return f"{len(problem.kk)} edges", lambda: solve(problem, options).poses_cw


def small_graph(generator: torch.Generator, device: torch.device) -> tuple[str, Call]:
    """Eight Levenberg-Marquardt steps on a window, as from each start of :mod:`dvo.ba.multistart`."""
    problem = window(generator, device)
    names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
    one = problem.with_values(**{name: getattr(problem, name)[0].double() for name in names}).planned()
    options = GlobalBAOptions(fixed=2, kernel=Kernel("cauchy", 0.3), solver=LMOptions(max_iterations=8, tolerance=0.0))
    return f"{len(problem.kk)} edges", lambda: solve(one, options).poses_cw


KERNELS: dict[str, Callable[[torch.Generator, torch.device], tuple[str, Call]]] = {
    "correlation, level 1": lambda generator, device: edge_correlation(generator, device, 1),
    "correlation, level 4": lambda generator, device: edge_correlation(generator, device, 4),
    "normalisation": normalisation,
    "alignment": alignment,
    "window solver": window_solver,
    "small graph": small_graph,
}
"""By name: a function of a random generator and a device that returns a description of the size and a call to time,
which asks :func:`dvo.core.kernels.use_kernels`."""
OF_A_CPU: dict[str, Callable[[torch.Generator, torch.device], tuple[str, Call]]] = {
    "scores of patches": scores,
    "update operator": update,
}
"""The same where other devices compute the twin."""


def encoder(generator: torch.Generator) -> tuple[str, Call, Call]:
    """Encoder of the network ``small``, untrained, in bfloat16 and in float32."""
    image = torch.randint(0, 256, (240, 320, 3), generator=generator, dtype=torch.uint8).permute(2, 0, 1)[None, None]

    def call(model: PatchVO) -> Call:
        return lambda: model.patchify.encode(normalise_images(image)).matching

    model = PatchVO(preset("small")).eval()
    return "320x240", call(model.in_bfloat16()), call(model)


def update_operator(generator: torch.Generator, precision: str) -> tuple[str, Call, Call]:
    """Update operator in a precision and in float32."""
    (size, lower), (_, single) = (
        of_update(torch.manual_seed(generator.initial_seed()), name) for name in (precision, "float32")
    )
    return size, lower, single


def correlation(generator: torch.Generator, dtype: torch.dtype) -> tuple[str, Call, Call]:
    """Look-up at the finer level in maps of a type and of float32."""
    seed = generator.initial_seed()
    (size, lower), (_, single) = (
        edge_correlation(torch.Generator().manual_seed(seed), CPU, 1, kind) for kind in (dtype, torch.float32)
    )
    return size, lower, single


PRECISIONS: dict[str, Callable[[torch.Generator], tuple[str, Call, Call]]] = {
    "encoder, bfloat16": encoder,
    "correlation, bfloat16": partial(correlation, dtype=torch.bfloat16),
    "update, bfloat16": partial(update_operator, precision="bfloat16"),
    "correlation, int8": partial(correlation, dtype=torch.uint8),
    "update, int8": partial(update_operator, precision="int8"),
}
"""By name: a function of a random generator that returns a description of the size, and calls in both precisions."""


def compare(call: Call, repeats: int, device: torch.device) -> tuple[float, float, float]:
    """Run a kernel and its twin in turns.

    Args:
        call: computes with either.
        repeats: number of runs of each, after one that is not timed.
        device: that computes, and is waited for.

    Returns:
        Median seconds of the kernel and of the twin, and the largest absolute difference of the results.
    """

    def chosen(choice: str) -> Tensor:
        with mock.patch.dict(os.environ, {VARIABLE: choice}):
            return call()

    kernel, twin = CHOICES
    return in_turns(lambda: chosen(kernel), lambda: chosen(twin), repeats, device)


def in_turns(one: Call, other: Call, repeats: int, device: torch.device) -> tuple[float, float, float]:
    """Run two computations in turns; see :func:`compare`."""
    calls, found = (one, other), [torch.empty(0), torch.empty(0)]
    seconds: tuple[list[float], list[float]] = ([], [])
    for repeat in range(repeats + 1):
        for k, call in enumerate(calls):
            start = time.perf_counter()
            found[k] = call()
            getattr(torch, device.type).synchronize()  # a module for each kind of device
            seconds[k].extend([time.perf_counter() - start] if repeat else [])
    largest = (found[0] - found[1]).abs().max().item()
    return statistics.median(seconds[0]), statistics.median(seconds[1]), largest


def main() -> None:
    """Run the benchmark and print a line for each kernel."""
    parser = OneLineParser(prog="python -m eval.benchmarks.kernels", description=__doc__)
    parser.add_argument("--only", default="", help="kernels whose names contain this")
    parser.add_argument("--repeats", type=int, default=20, help="(%(default)s)")
    options = parser.parse_args()
    kernels = KERNELS | OF_A_CPU
    names = (*kernels, *PRECISIONS)
    chosen = [name for name in names if options.only in name]
    if not chosen or options.repeats < 1:
        parser.error(f"no run: --only is part of {', '.join(names)}, --repeats at least 1")
    torch.set_num_threads(1)
    print(f"{'kernel':24} {'size':28} {'ms':>8} {'twin ms':>8} {'ratio':>6} {'difference':>11}")
    with torch.inference_mode():
        for name in chosen:
            generator = torch.manual_seed(0)  # also of untrained networks
            if name in kernels:
                size, call = kernels[name](generator, CPU)
                kernel, twin, largest = compare(call, options.repeats, CPU)
            else:
                size, lower, single = PRECISIONS[name](generator)
                kernel, twin, largest = in_turns(lower, single, options.repeats, CPU)
            print(f"{name:24} {size:28} {1e3 * kernel:8.2f} {1e3 * twin:8.2f} {twin / kernel:6.1f} {largest:11.1e}")


if __name__ == "__main__":
    main()
