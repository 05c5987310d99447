"""Encoder of the patch-flow network as an ONNX file, and its comparison with torch by onnxruntime (extra ``onnx``)."""

from __future__ import annotations

import inspect
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.data.files.output import replaced
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import load_weights

OPSET = 17
"""Version of the operators: read by onnxruntime 1.12 and newer, and by TensorRT 8.5 and newer."""

TOLERANCE = 1e-3
"""Largest difference to torch over the largest value of an output that is accepted."""

_SIZES = ((1, 96, 128), (2, 120, 160), (3, 64, 200))  # batch, height and width of the images that are compared
_TRACED = (1, 96, 128)


@dataclass(frozen=True)
class OnnxEncoder:
    """ONNX file of an encoder.

    Attributes:
        file: path.
        outputs: names and number of channels of the outputs.
        difference: largest absolute difference to torch over all outputs and compared sizes.
        relative: the same over the largest value of the output.
    """

    file: Path
    outputs: dict[str, int]
    difference: float
    relative: float


def export_encoder(weights: str | Path, file: str | Path) -> OnnxEncoder:
    """Write the encoder as ONNX and compare it with torch on images of several sizes, on the CPU.

    The input ``images`` is ``(n, 3, H, W)`` float32, RGB in 0 to 255, H and W multiples of 4; the normalisation is in
    the file. Outputs: :meth:`dvo.nets.patch.frame_encoder.FrameEncoder.forward`. Number and size of images are free.

    Args:
        weights: shipped weights by name, or a safetensors file, of the architecture ``patch_vo``.
        file: ``*.onnx`` to write.

    Returns:
        The file, and the differences.

    Raises:
        DvoError: weights of another architecture, a missing package, or outputs that differ from those of torch.
        OSError: the file cannot be written.
    """
    check_installed()
    loaded = load_weights(weights)
    if not isinstance(loaded.model, PatchVO):
        message = f"the architecture {loaded.model.architecture} has no such encoder"
        raise DvoError(message, file=weights, field="weights", remedy="give weights of patch_vo, such as small")
    encoder = loaded.model.eval().encoder
    facts = {"weights": loaded.name, "architecture": "patch_vo", "input": "RGB, 0 to 255, H and W multiples of 4"}
    with replaced(Path(file)) as part:
        _export(encoder, part, facts)
        outputs, difference, relative = _compare(encoder, part)
        if not relative <= TOLERANCE:  # NaN fails too
            message = f"differs from torch by {difference:.3g}, {relative:.3g} of the largest value"
            raise DvoError(message, file=file, remedy="try other versions of torch, onnx and onnxruntime")
    return OnnxEncoder(Path(file), outputs, difference, relative)


def check_installed() -> None:
    """Check that the packages of the extra ``onnx`` are there.

    Raises:
        DvoError: one is missing.
    """
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise DvoError(f"no module {error.name}", field="onnx", remedy="pip install 'dvo[onnx]'") from None


def _export(encoder: torch.nn.Module, file: Path, facts: dict[str, str]) -> None:
    """Trace the encoder. The exporter by TorchScript is the one that all versions of torch in use have, and it needs no
    onnxscript."""
    import onnx

    names = list(encoder.names)  # type: ignore[arg-type]
    axes = {name: {0: "n", 2: f"height_{name}", 3: f"width_{name}"} for name in names}
    options: dict[str, Any] = {}
    if "dynamo" in inspect.signature(torch.onnx.export).parameters:  # torch 2.5 and newer
        options["dynamo"] = False
    batch, height, width = _TRACED
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter announces its successor
        torch.onnx.export(
            encoder, (torch.zeros(batch, 3, height, width),), str(file), input_names=["images"], output_names=names,
            dynamic_axes={"images": {0: "n", 2: "height", 3: "width"}, **axes}, opset_version=OPSET, **options,
        )  # fmt: skip
    graph = onnx.load(str(file))
    onnx.checker.check_model(graph)
    onnx.helper.set_model_props(graph, {name: json.dumps(value) for name, value in facts.items()})
    onnx.save(graph, str(file))


def _compare(encoder: torch.nn.Module, file: Path) -> tuple[dict[str, int], float, float]:
    """Channels of the outputs, and the largest absolute and relative difference."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    difference, relative, channels = 0.0, 0.0, {}
    for seed, (batch, height, width) in enumerate(_SIZES):
        images = np.random.default_rng(seed).uniform(0, 255, (batch, 3, height, width)).astype(np.float32)
        with torch.no_grad():
            expected = encoder(torch.from_numpy(images))
        outputs = session.run(None, {"images": images})
        for node, found, reference in zip(session.get_outputs(), outputs, expected, strict=True):
            if found.shape != tuple(reference.shape):
                return {}, float("inf"), float("inf")
            gap = float(np.abs(found - reference.numpy()).max())
            difference, relative = max(difference, gap), max(relative, gap / float(reference.abs().max()))
            channels[node.name] = found.shape[1]
    return channels, difference, relative
