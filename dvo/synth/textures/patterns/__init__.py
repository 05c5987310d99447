"""Procedural patterns: functions ``(rng, size)`` that draw one ``(S, S, 3)`` float32 RGB image in [0, 1].

``PATTERNS`` maps a name to (function, tag); scenes select by tag ("facade", "floor"...), so that walls look like walls.
``SPECIAL`` holds patterns that only scenes which name their tags get.
"""

from __future__ import annotations

from dvo.synth.textures.patterns.base import Pattern, Rng
from dvo.synth.textures.patterns.prints import facade, foliage, leaves, painting, panel, shelf, stripes, text, wallpaper
from dvo.synth.textures.patterns.surfaces import (
    asphalt,
    bark,
    bricks,
    cells,
    clouds,
    fractal,
    grass,
    marble,
    plain,
    roof,
    stains,
    tiles,
    wood,
)

PATTERNS: dict[str, tuple[Pattern, str]] = {
    "fractal": (fractal, "stone"),
    "stains": (stains, "wall"),
    "plain": (plain, "plain"),
    "cells": (cells, "stone"),
    "bricks": (bricks, "wall"),
    "tiles": (tiles, "floor"),
    "wood": (wood, "floor"),
    "stripes": (stripes, "cloth"),
    "leaves": (leaves, "busy"),
    "foliage": (foliage, "plant"),
    "grass": (grass, "ground"),
    "asphalt": (asphalt, "road"),
    "facade": (facade, "facade"),
    "text": (text, "poster"),
    "shelf": (shelf, "busy"),
    "panel": (panel, "panel"),
    "clouds": (clouds, "sky"),
}
SPECIAL: dict[str, tuple[Pattern, str]] = {
    "bark": (bark, "bark"),
    "marble": (marble, "marble"),
    "roof": (roof, "roof"),
    "wallpaper": (wallpaper, "wallpaper"),
    "painting": (painting, "painting"),
}

__all__ = ["PATTERNS", "SPECIAL", "Pattern", "Rng"]
