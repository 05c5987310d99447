"""Signal-to-noise ratio of the gradients of a task's losses.

V2V claims that weighting the flow error by the confidence lowers the variance of the gradient. Here the losses that a
task offers (:meth:`train.tasks.task.Task.loss_variants`; for ``patch_vo`` the flow loss, plain and weighted) are
computed from the same forward passes of the same checkpoint: one gradient of the probed parameters (for ``patch_vo``
those of the two heads) for each clip, then

    signal = ||mean g||,    noise = mean ||g - mean g||,    SNR = signal / noise.

With N clips even pure noise has an SNR of about 1 / sqrt(N), which is printed beside.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from dvo.core.command_line import OneLineParser
from dvo.synth.dataset import ClipDataset
from train.engine.checkpoint import fill, read_state, task_of
from train.tasks.task import Batch, Task

SEED = 910_001
"""Stream of the clips, neither of training nor of validation."""


def signal_to_noise(gradients: np.ndarray) -> float:
    """SNR of per-sample gradients ``(N, P)``; infinite without noise."""
    mean = gradients.mean(0)
    noise = np.linalg.norm(gradients - mean, axis=1).mean()
    return float(np.linalg.norm(mean) / noise) if noise > 0 else float("inf")


def clip_gradients(task: Task, net: nn.Module, batch: Batch, seed: int) -> dict[str, np.ndarray]:
    """Gradient of each loss of one clip with respect to the probed parameters.

    Args:
        task: gives losses and parameters.
        net: the network.
        batch: a clip, as a batch of one.
        seed: of everything that the network draws.

    Returns:
        one float64 vector ``(P,)`` a loss; zero where a loss does not depend on a parameter.
    """
    parameters = [net.get_parameter(name) for name in task.probed_parameters(net)]
    found = {}
    for name, loss in task.loss_variants(net, batch, seed).items():
        gradients = torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
        vectors = [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, gradients, strict=True)]
        found[name] = torch.cat([vector.flatten() for vector in vectors]).numpy().astype(np.float64)
    return found


@dataclass(frozen=True)
class Ratio:
    """SNR of one loss with a bootstrap interval, and its ratio to the reference on the same resampled clips.

    Attributes:
        snr, low, high: estimate and 90 % interval.
        gain, gain_low, gain_high: ratio to the reference and its 90 % interval.
    """

    snr: float
    low: float
    high: float
    gain: float
    gain_low: float
    gain_high: float


def compare(gradients: dict[str, np.ndarray], draws: int = 400) -> dict[str, Ratio]:
    """SNR of each loss, and its gain over the first one, with 90 % intervals over resampled clips (paired).

    Args:
        gradients: ``(N, P)`` a loss.
        draws: number of resamplings.
    """
    rng = np.random.default_rng(0)
    reference = next(iter(gradients))
    count = len(gradients[reference])
    samples: dict[str, list[float]] = {name: [] for name in gradients}
    for _ in range(draws):
        chosen = rng.integers(count, size=count)
        for name, g in gradients.items():
            samples[name].append(signal_to_noise(g[chosen]))
    base = signal_to_noise(gradients[reference])
    result = {}
    for name, g in gradients.items():
        snr, drawn = signal_to_noise(g), np.array(samples[name])
        gains = drawn / np.array(samples[reference])
        # Resampling repeats clips, which raises the SNR a little; the interval is shifted back around the estimate.
        low, high = np.quantile(drawn, [0.05, 0.95]) - np.median(drawn) + snr
        gain_low, gain_high = np.quantile(gains, [0.05, 0.95]) - np.median(gains) + snr / base
        result[name] = Ratio(snr, float(low), float(high), snr / base, float(gain_low), float(gain_high))
    return result


def table(results: dict[str, Ratio], clips: int) -> str:
    """Text of the results; the last line compares the second loss with the first."""
    names = list(results)
    rows = [f"SNR of the gradient at the probed parameters, {clips} clips, 90 % intervals of the bootstrap over clips"]
    rows.append(f"{'loss':26s} {'SNR':>7s} {'interval':>17s} {'dB':>7s} {'gain':>10s} {'interval':>13s}")
    for name, r in results.items():
        rows.append(
            f"{name:26s} {r.snr:7.3f} [{r.low:7.3f} {r.high:7.3f}] {20 * np.log10(r.snr):7.2f} "
            f"{r.gain:10.2f} [{r.gain_low:5.2f} {r.gain_high:5.2f}]"
        )
    rows.append(f"pure noise would have about {clips**-0.5:.3f}; gain: over '{names[0]}'")
    if len(names) > 1:
        gain = results[names[1]]
        verb = "raises" if gain.gain_low > 1 else "lowers" if gain.gain_high < 1 else "does not clearly change"
        rows.append(f"the loss '{names[1]}' {verb} the signal-to-noise ratio on this checkpoint")
    return "\n".join(rows)


def main(arguments: list[str]) -> None:
    """``python -m train snr CHECKPOINT [--clips N]``.

    Raises:
        DvoError: no such checkpoint, or one that cannot be read.
    """
    parser = OneLineParser(prog="python -m train snr", description=__doc__.split("\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--clips", type=int, default=200)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--updates", type=int, default=10, help="of tasks that have this setting")
    parser.add_argument("--initial", type=int, help="frames of the first graph; default: all")
    parser.add_argument("--size", type=int, nargs=2, default=(120, 160), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--flow", type=float, nargs=2, default=(2.0, 14.0), metavar=("LOW", "HIGH"))
    parser.add_argument("--flow-weight", type=float, help="of the flow loss; default: the task's")
    parser.add_argument("--patches", type=int, help="patches a frame; default: the preset's")
    parser.add_argument("--averaged", action="store_true", help="the moving average instead of the weights in training")
    options = parser.parse_args(arguments)
    state = read_state(options.checkpoint)
    changes = {} if options.flow_weight is None else {"loss": {"flow": options.flow_weight}}
    task = task_of(state, updates=options.updates, initial=options.initial, patches=options.patches, **changes)
    net = task.network()
    fill(net, state, "average" if options.averaged else "net", options.checkpoint)
    height, width = options.size
    clips = ClipDataset(
        SEED, options.clips, frames=options.frames, height=height, width=width, flow_range=tuple(options.flow)
    )
    found: dict[str, list[np.ndarray]] = {}
    for index in range(options.clips):
        batch = {name: value[None] for name, value in clips[index].items()}
        for name, g in clip_gradients(task, net, batch, index).items():
            found.setdefault(name, []).append(g)
        if (index + 1) % 20 == 0:
            print(f"{index + 1} clips", flush=True)
    print(table(compare({name: np.stack(g) for name, g in found.items()}), options.clips))
