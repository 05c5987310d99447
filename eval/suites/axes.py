"""Rendered suites of axes.yaml, memory.yaml, world.yaml, inertial.yaml in configs/eval: seed, options of sequences."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from dvo.core.errors import DvoError
from dvo.core.settings import Range, from_table

Table = dict[str, Any]
_SEED = (0, 2**53)


@dataclass(frozen=True)
class Split:
    """Purpose of sequences, and their first seed."""

    RANGES: ClassVar[dict[str, Range]] = {"seed": _SEED}

    seed: int
    label: str


@dataclass(frozen=True)
class Tier:
    """Number, length in seconds, rate and sizes (width, height; taken in turn) of the sequences of a suite."""

    RANGES: ClassVar[dict[str, Range]] = {
        "seed": _SEED,
        "count": (1, 1000),
        "seconds": (0.1, 3600),
        "fps": (0.1, 1000),
    }

    seed: int
    count: int
    seconds: float
    fps: float
    sizes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Variant:
    """Part of the sequences of an axis, as many as the tier says.

    Attributes:
        options: added to those of the axis.
        inertial: options of :class:`eval.suites.inertial.Stream` but the seed; None for no inertial samples.
        clip: ``[axis, variant]`` whose renderings these sequences are, with their options; None for renderings of
            their own.
    """

    options: dict[str, Any] = field(default_factory=dict)
    inertial: dict[str, Any] | None = None
    clip: tuple[str, str] | None = None


@dataclass(frozen=True)
class Axis:
    """Options of the sequences of a suite; ``about`` and ``judged_by`` as in :class:`eval.suites.suite.Sequence`, and
    ``seconds`` in place of those of the tier. With ``variants``, by name, there are sequences of each."""

    RANGES: ClassVar[dict[str, Range]] = {"seed": _SEED, "seconds": (0.1, 3600)}

    seed: int
    about: str
    options: dict[str, Any]
    families: tuple[str, ...] | None = None
    judged_by: str | None = None
    seconds: float | None = None
    variants: dict[str, Variant] = field(default_factory=dict)


@dataclass(frozen=True)
class Axes:
    """Content of the file.

    Attributes:
        version: of the renderings.
        families: of scenes, taken in turn.
        splits, tiers, axes: by name.
        common: options of all sequences.
        alignment: of all suites, see :class:`eval.suites.suite.Suite`.
    """

    version: int
    families: tuple[str, ...]
    splits: dict[str, Split]
    tiers: dict[str, Tier]
    axes: dict[str, Axis]
    common: dict[str, Any] = field(default_factory=dict)
    alignment: str = "sim3"


def read_axes(table: Any, file: Path) -> Axes:
    """Check the content of the file.

    Args:
        table: as read.
        file: for messages.

    Raises:
        DvoError: a setting is missing, unknown, of another type or out of range.
    """
    found = from_table(Axes, table, file)
    lists: dict[str, tuple[Any, ...] | None] = {"families": found.families}
    lists |= {f"axes: {name}: families": axis.families for name, axis in found.axes.items()}
    lists |= {f"tiers: {name}: sizes": tier.sizes for name, tier in found.tiers.items()}
    for place, values in lists.items():
        if values is not None and not values:
            raise DvoError("an empty list", file=file, field=place, remedy="give one or more")
    return found


def expand(table: Axes, axis: str, split: str, tier: str) -> Table:
    """One suite as a table of settings, its sequences with the options of :func:`dvo.synth.make_sequence`.

    Args:
        table: content of the file.
        axis, split, tier: of the suite.
    """
    what, part, size = table.axes[axis], table.splits[split], table.tiers[tier]
    sequences = []
    for name in what.variants or ("",):
        variant = what.variants.get(name, Variant())
        for k in range(size.count):
            clip = variant.clip or (axis, name)
            options = _options(table, *clip, split, tier, k)
            entry: Table = {
                "name": _name(axis, name, split, tier, k),
                "about": what.about,
                "rendered": [list(pair) for pair in sorted(options.items())],
            }
            if clip != (axis, name):
                entry["clip"] = _name(*clip, split, tier, k)
            if variant.inertial is not None:
                entry["inertial"] = [
                    list(pair) for pair in sorted({**variant.inertial, "seed": options["seed"]}.items())
                ]
            if what.judged_by is not None:
                entry["judged_by"] = what.judged_by
            sequences.append(entry)
    return {
        "name": "/".join([axis, *([split] if split != "validation" else []), *([tier] if tier != "mini" else [])]),
        "label": part.label,
        "alignment": table.alignment,
        "sequences": sequences,
    }


def _name(axis: str, variant: str, split: str, tier: str, number: int) -> str:
    """Name of a sequence."""
    parts = [axis, split, tier if tier != "mini" else "", variant, str(number)]
    return "_".join(part for part in parts if part)


def _options(table: Axes, axis: str, variant: str, split: str, tier: str, k: int) -> Table:
    """Options of the rendering of a sequence, the ``k``-th of its variant, with its version."""
    what, part, size = table.axes[axis], table.splits[split], table.tiers[tier]
    number = k + size.count * (list(what.variants).index(variant) if variant else 0)
    families = what.families or table.families
    width, height = size.sizes[number % len(size.sizes)]
    return {
        **table.common,
        **what.options,
        **(what.variants[variant].options if variant else {}),
        "seed": part.seed + what.seed + size.seed + number,
        "family": families[(list(table.axes).index(axis) + number) % len(families)],
        "frames": round((what.seconds or size.seconds) * size.fps),
        "fps": float(size.fps),
        "width": width,
        "height": height,
        "version": table.version,
    }


def choose(text: str, table: Axes, group: str) -> list[tuple[str, str, str]]:
    """``NAME[/SPLIT][/TIER]`` to (axis, split, tier): of one axis, or of all if the name is the ``group``'s alone.

    Args:
        text: as on the command line.
        table: content of the file.
        group: name of all axes together.

    Raises:
        DvoError: no such axis, split or tier.
    """
    name, *rest = text.split("/")
    split, tier = "validation", "mini"
    for word in rest:
        if word in table.splits:
            split = word
        elif word in table.tiers:
            tier = word
        else:
            known = ", ".join([*table.splits, *table.tiers])
            raise DvoError(f"no split or tier '{word}'", field="--suite", remedy=f"choose from {known}")
    for kind, word, known_words in (("split", split, table.splits), ("tier", tier, table.tiers)):
        if word not in known_words:
            raise DvoError(f"no {kind} '{word}'", field="--suite", remedy=f"choose from {', '.join(known_words)}")
    return [(axis, split, tier) for axis in (table.axes if name == group and name not in table.axes else [name])]
