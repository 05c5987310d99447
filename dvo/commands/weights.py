"""``dvo weights list | import | info``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dvo.errors import DvoError
from dvo.models.weights import WeightsInfo, import_checkpoint, list_weights, weights_info
from dvo.odometry.results import jsonable


def list_shipped(arguments: argparse.Namespace) -> int:
    """Print a row for each of the weights in the package; returns the exit code."""
    found = list_weights()
    if not found:
        print("no weights ship with this copy of dvo")
        return 0
    table = Table(box=None, pad_edge=False)
    table.add_column("name")
    table.add_column("architecture")
    table.add_column("preset")
    table.add_column("parameters", justify="right")
    table.add_column("MB", justify="right")
    for weights in found:
        size = f"{weights.path.stat().st_size / 1e6:.1f}"
        table.add_row(weights.name, weights.architecture, weights.preset, f"{weights.parameters:,}", size)
    Console().print(table)
    return 0


def import_file(arguments: argparse.Namespace) -> int:
    """Convert a DPVO checkpoint, never over an existing file; returns the exit code.

    Raises:
        DvoError: the file to write is there already, or see :func:`dvo.models.weights.import_checkpoint`.
    """
    out = Path(arguments.out or Path(arguments.file).with_suffix(".safetensors").name)
    if out.exists():
        raise DvoError("exists already", file=out, field="--out", remedy="name another file, or remove this one")
    describe(import_checkpoint(arguments.file, out))
    print(f"use it as: dvo run SOURCE --weights {out}")
    return 0


def info(arguments: argparse.Namespace) -> int:
    """Print the metadata of a weights file; returns the exit code.

    Raises:
        DvoError: see :func:`dvo.models.weights.weights_info`.
    """
    describe(weights_info(arguments.weights))
    return 0


def describe(weights: WeightsInfo) -> None:
    """Print one fact a line."""
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
        print(f"{name:<{width}}  {value if isinstance(value, str) else json.dumps(jsonable(value))}")
