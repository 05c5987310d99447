"""``dvo weights list | import | info``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from dvo.errors import DvoError
from dvo.models.weights import WeightsInfo, import_checkpoint, list_weights, weights_info
from dvo.odometry.results import jsonable


def list_shipped(arguments: argparse.Namespace) -> int:
    """A row for each of the weights in the package."""
    found = list_weights()
    if not found:
        print("no weights ship with this copy of dvo")
        return 0
    table = Table(box=None, pad_edge=False)
    table.add_column("name")
    table.add_column("preset")
    table.add_column("parameters", justify="right")
    table.add_column("MB", justify="right")
    for weights in found:
        size = f"{weights.path.stat().st_size / 1e6:.1f}"
        table.add_row(weights.name, weights.preset, f"{weights.parameters:,}", size)
    Console().print(table)
    return 0


def import_file(arguments: argparse.Namespace) -> int:
    """Convert a DPVO checkpoint; never over an existing file."""
    out = Path(arguments.out or Path(arguments.file).with_suffix(".safetensors").name)
    if out.exists():
        raise DvoError("exists already", file=out, field="--out", remedy="name another file, or remove this one")
    describe(import_checkpoint(arguments.file, out))
    print(f"use it as: dvo run SOURCE --weights {out}")
    return 0


def info(arguments: argparse.Namespace) -> int:
    """Everything that a weights file says of itself."""
    describe(weights_info(arguments.weights))
    return 0


def describe(weights: WeightsInfo) -> None:
    """Print one fact a line."""
    print(f"name        {weights.name}")
    print(f"file        {weights.path}")
    print(f"preset      {weights.preset}")
    print(f"size        {weights.parameters:,} parameters in {weights.tensors} tensors")
    print(f"sha256      {weights.sha256}")
    print(f"config      {json.dumps(jsonable(weights.config))}")
    for name, value in weights.card.items():
        print(f"{name:<11} {value if isinstance(value, str) else json.dumps(jsonable(value))}")
