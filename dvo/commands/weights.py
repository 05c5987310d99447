"""``dvo weights list``, ``import``, ``onnx`` and ``info``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dvo.commands.console import say
from dvo.core.errors import DvoError
from dvo.core.text import printable
from dvo.models.weights import WeightsInfo, import_checkpoint, list_weights, weights_info
from dvo.session.results import jsonable


def list_shipped(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo weights list``: print a row for each weights file of the package.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.
    """
    found = list_weights()
    if not found:
        say("this installation of dvo has no weights")
        return 0
    table = Table(box=None, pad_edge=False)
    table.add_column("name")
    table.add_column("architecture")
    table.add_column("preset")
    table.add_column("parameters", justify="right")
    table.add_column("MB", justify="right")
    for weights in found:
        size = f"{weights.path.stat().st_size / 1e6:.1f}"
        table.add_row(
            *map(_cell, (weights.name, weights.architecture, weights.preset)), f"{weights.parameters:,}", size
        )
    Console().print(table)
    return 0


def _cell(text: object) -> str:
    return escape(printable(text))


def import_file(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo weights import``: convert a published checkpoint; an existing file is not overwritten.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: the output file exists, or see :func:`dvo.models.weights.import_checkpoint`.
    """
    file = Path(arguments.file)
    if not file.is_file():
        raise DvoError("no such file", file=arguments.file, remedy="give a checkpoint of DPVO, DROID-SLAM or TartanVO")
    out = Path(arguments.out or file.with_suffix(".safetensors").name)
    if out.exists():
        raise DvoError("already exists", file=out, field="--out", remedy="give another file, or remove this one")
    describe(import_checkpoint(file, out))
    say(f"use it with: dvo run SOURCE --weights {out}")
    return 0


def export_onnx(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo weights onnx``: write the encoder as ONNX; an existing file is not overwritten.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: the output file exists, or see :func:`dvo.models.onnx_export.export_encoder`.
    """
    from dvo.models.onnx_export import export_encoder

    out = Path(arguments.out or f"{Path(arguments.weights).stem}-encoder.onnx")
    if out.exists():
        raise DvoError("already exists", file=out, field="--out", remedy="give another file, or remove this one")
    found = export_encoder(arguments.weights, out)
    outputs = ", ".join(f"{name} ({channels} channels)" for name, channels in found.outputs.items())
    say(f"encoder in {out}: images (n, 3, H, W) float32, RGB 0 to 255, to {outputs}")
    say(f"largest difference to torch {found.difference:.2g}, {found.relative:.2g} of the largest value")
    return 0


def info(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo weights info``: print the metadata of a weights file.

    Args:
        arguments: of the command line.

    Returns:
        Exit code.

    Raises:
        DvoError: see :func:`dvo.models.weights.weights_info`.
    """
    describe(weights_info(arguments.weights))
    return 0


def describe(weights: WeightsInfo) -> None:
    """Print the metadata of weights, one value a line.

    Args:
        weights: the metadata.
    """
    facts: dict[str, Any] = {
        "name": weights.name,
        "file": str(weights.path),
        "architecture": weights.architecture,
        "preset": weights.preset,
        "size": f"{weights.parameters:,} parameters in {weights.tensors} tensors",
        "sha256": weights.sha256,
        "config": weights.config.to_dict(),
    }
    width = max(map(len, [*facts, *weights.card]))
    for name, value in [*facts.items(), *weights.card.items()]:
        text = value if isinstance(value, str) and value.isprintable() else json.dumps(jsonable(value))
        say(f"{name if name.isprintable() else json.dumps(name):<{width}}  {text}")
