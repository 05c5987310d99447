"""Signal-to-noise ratio of the flow loss's gradient at the heads of the update operator, plain and weighted.

V2V claims that weighting the flow error by the confidence lowers the variance of the gradient. Here both losses are
computed from the same forward passes of the same checkpoint: one gradient of the flow-revision and the confidence head
for each clip, then

    signal = ||mean g||,    noise = mean ||g - mean g||,    SNR = signal / noise.

With N clips even pure noise has an SNR of about 1 / sqrt(N), which is printed beside.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.losses.flow import flow_error, flow_loss, weighted_flow_error
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import Stage, training_schedule
from dvo.nets.config import preset
from dvo.synth.dataset import ClipDataset
from train.tasks.patch_vo.objective import true_reprojection, truth_of

HEADS = ("update.d.1.weight", "update.w.1.weight")
SEED = 910_001  # neither of training nor of validation


@dataclass(frozen=True)
class Variant:
    """One flow loss: weighted or not, over nearby edges (0 < |i - j| <= 2) or all."""

    weighted: bool
    all_edges: bool

    def __str__(self) -> str:
        return f"{'weighted' if self.weighted else 'plain'}, {'all' if self.all_edges else 'near'} edges"


DPVO, V2V = Variant(False, False), Variant(True, True)
VARIANTS = (DPVO, V2V, Variant(False, True), Variant(True, False))


def signal_to_noise(gradients: np.ndarray) -> float:
    """SNR of per-sample gradients ``(N, P)``."""
    mean = gradients.mean(0)
    noise = np.linalg.norm(gradients - mean, axis=1).mean()
    return float(np.linalg.norm(mean) / noise) if noise > 0 else float("inf")


def clip_gradients(
    model: PatchVO, batch: dict[str, Tensor], stages: list[Stage], seed: int, flow: float = 0.1, margin: float = 4.0
) -> dict[Variant, np.ndarray]:
    """Gradient of each flow loss of one clip with respect to both heads, one vector.

    Args:
        batch: a clip, as a batch of one.
        flow: weight of the loss; it matters because the heads clamp their gradients.
    """
    truth = truth_of(batch, model.config.STRIDE)
    b, n = batch["images"].shape[:2]
    sums: dict[Variant, Tensor] = {}
    there: Any = None
    graph = None
    states = model.unroll(
        batch["images"], batch["intrinsics"], stages, poses_cw=se3.identity(b, n),
        generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip
    for state in states:
        if state.graph is not graph:
            graph = state.graph
            there = true_reprojection(truth, state.patches.detach(), graph, state.frames, margin)
        distance = (state.graph.ii - state.graph.jj).abs()
        near = (distance > 0) & (distance <= 2)
        errors = {
            False: flow_error(state.coords, *there),
            True: weighted_flow_error(state.coords, *there, state.weights),
        }
        for variant in VARIANTS:
            edges = torch.ones_like(near) if variant.all_edges else near
            term = flow * flow_loss(errors[variant.weighted], edges)
            sums[variant] = sums[variant] + term if variant in sums else term
    found = {}
    for variant, loss in sums.items():
        heads = torch.autograd.grad(loss, [model.get_parameter(name) for name in HEADS], retain_graph=True)
        found[variant] = torch.cat([g.flatten() for g in heads]).numpy().astype(np.float64)
    return found


@dataclass(frozen=True)
class Ratio:
    """SNR of one variant with a bootstrap interval, and its ratio to the plain loss on the same resampled clips."""

    snr: float
    low: float
    high: float
    gain: float
    gain_low: float
    gain_high: float


def compare(gradients: dict[Variant, np.ndarray], reference: Variant = DPVO, draws: int = 400) -> dict[Variant, Ratio]:
    """SNR of each variant, and its gain over the reference, with 90 % intervals over resampled clips (paired)."""
    rng = np.random.default_rng(0)
    count = len(next(iter(gradients.values())))
    samples: dict[Variant, list[float]] = {variant: [] for variant in gradients}
    for _ in range(draws):
        chosen = rng.integers(count, size=count)
        for variant, g in gradients.items():
            samples[variant].append(signal_to_noise(g[chosen]))
    base = signal_to_noise(gradients[reference])
    result = {}
    for variant, g in gradients.items():
        snr, drawn = signal_to_noise(g), np.array(samples[variant])
        gains = drawn / np.array(samples[reference])
        # Resampling repeats clips, which raises the SNR a little; the interval is shifted back around the estimate.
        low, high = np.quantile(drawn, [0.05, 0.95]) - np.median(drawn) + snr
        gain_low, gain_high = np.quantile(gains, [0.05, 0.95]) - np.median(gains) + snr / base
        result[variant] = Ratio(snr, float(low), float(high), snr / base, float(gain_low), float(gain_high))
    return result


def table(results: dict[Variant, Ratio], clips: int) -> str:
    """What the command prints."""
    rows = [f"SNR of the flow loss's gradient at the heads, {clips} clips, 90 % intervals of the bootstrap over clips"]
    rows.append(f"{'flow loss':24s} {'SNR':>7s} {'interval':>17s} {'dB':>7s} {'over DPVO':>10s} {'interval':>13s}")
    for variant, r in results.items():
        mark = " (DPVO)" if variant == DPVO else " (V2V)" if variant == V2V else ""
        rows.append(
            f"{str(variant) + mark:24s} {r.snr:7.3f} [{r.low:7.3f} {r.high:7.3f}] {20 * np.log10(r.snr):7.2f} "
            f"{r.gain:10.2f} [{r.gain_low:5.2f} {r.gain_high:5.2f}]"
        )
    rows.append(f"pure noise would have about {clips**-0.5:.3f}")
    gain = results[V2V]
    says = "raises" if gain.gain_low > 1 else "lowers" if gain.gain_high < 1 else "does not clearly change"
    rows.append(f"the weighted flow loss {says} the signal-to-noise ratio on this checkpoint")
    return "\n".join(rows)


def main(arguments: list[str]) -> None:
    """``python -m train snr CHECKPOINT [--clips N]``."""
    parser = argparse.ArgumentParser(prog="python -m train snr", description=__doc__.split("\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--clips", type=int, default=200)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--updates", type=int, default=10)
    parser.add_argument("--initial", type=int, help="frames of the first graph; default: all")
    parser.add_argument("--size", type=int, nargs=2, default=(120, 160), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--flow", type=float, nargs=2, default=(2.0, 14.0), metavar=("LOW", "HIGH"))
    parser.add_argument("--flow-weight", type=float, default=0.1, help="of the loss, as in training")
    parser.add_argument("--patches", type=int, help="patches a frame; default: the preset's")
    parser.add_argument("--averaged", action="store_true", help="the moving average instead of the weights in training")
    options = parser.parse_args(arguments)
    state = torch.load(options.checkpoint, map_location="cpu", weights_only=False)  # our own file: Lightning's
    config = preset(state["hyper_parameters"]["model"])
    if options.patches:
        config = replace(config, training_patches=options.patches)
    model = PatchVO(config)
    prefix = "average." if options.averaged else "net."
    model.load_state_dict({k.removeprefix(prefix): v for k, v in state["state_dict"].items() if k.startswith(prefix)})
    height, width = options.size
    clips = ClipDataset(
        SEED, options.clips, frames=options.frames, height=height, width=width, flow_range=tuple(options.flow)
    )
    stages = training_schedule(
        options.frames, config.training_patches, options.updates, options.initial, self_edges=config.self_edges
    )
    found: dict[Variant, list[np.ndarray]] = {variant: [] for variant in VARIANTS}
    for index in range(options.clips):
        batch = {name: value[None] for name, value in clips[index].items()}
        for variant, g in clip_gradients(model, batch, stages, index, options.flow_weight).items():
            found[variant].append(g)
        if (index + 1) % 20 == 0:
            print(f"{index + 1} clips", flush=True)
    print(table(compare({variant: np.stack(g) for variant, g in found.items()}), options.clips))
