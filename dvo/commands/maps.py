"""Maps on the command line: ``dvo run --map`` and ``dvo merge``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

import dvo
from dvo.commands import NOT_RECOGNISED, OK
from dvo.commands.console import device_of, say, seed_everything, warn
from dvo.commands.places import check_outputs
from dvo.commands.report import describe_localisation
from dvo.core.errors import DvoError
from dvo.data.files.output import check_place
from dvo.odometry.merging import merge_maps
from dvo.odometry.protocol import Odometry

DEFAULT_WEIGHTS = "small"  # of --weights; with a map: those of the map


def load_in_map(file: str, weights: str, device: torch.device, seed: int, settings: dict[str, Any]) -> Odometry:
    """Odometry of a new recording in the map of ``--map``.

    Args:
        file: of the map.
        weights: of ``--weights``; the default stands for those that the map names.
        device: of all computation.
        seed: of the odometry.
        settings: on top of those of the map.

    Returns:
        The odometry.

    Raises:
        DvoError: no such map, weights that are not found or not its own, or a setting that does not go with it.
    """
    if "new_recording" in settings:
        raise DvoError("not a setting of the odometry", field="new_recording", remedy="leave it out")
    place = None if weights == DEFAULT_WEIGHTS else weights
    return dvo.load_map(file, device=device, weights=place, seed=seed, **settings)


def merge(arguments: argparse.Namespace) -> int:
    """Entry point of ``dvo merge``.

    Args:
        arguments: of the command line.

    Returns:
        Exit code: 1 if no place of the second map was recognised in the first; then nothing is written.

    Raises:
        DvoError: an invalid map, maps that do not go together, or a file that cannot be written.
    """
    out = Path(arguments.out)
    check_outputs({"--out": out}, {"FIRST": arguments.first, "SECOND": arguments.second})
    check_place(out, "--out")
    seed_everything(0)
    odometry = merge_maps(arguments.first, arguments.second, device=device_of(arguments.device))
    localised = odometry.finish().info["localised"]
    if localised is None:
        warn(f"no place of {arguments.second} was recognised in {arguments.first}: nothing is written", "not merged")
        return NOT_RECOGNISED
    odometry.save(out)
    say(f"{arguments.second} {describe_localisation(localised)} of {arguments.first}; map in {out}")
    return OK
