"""Rendered suites of configs/eval/axes.yaml: seed and options of each sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dvo.errors import DvoError

Table = dict[str, Any]


def expand(table: Table, file: Path, axis: str, split: str, tier: str) -> Table:
    """One suite as a table of settings, its sequences with the options of :func:`dvo.synth.make_sequence`.

    Args:
        table: content of the file.
        file: for messages.
        axis, split, tier: of the suite.

    Raises:
        DvoError: the file lacks a setting.
    """
    try:
        what, part, size = table["axes"][axis], table["splits"][split], table["tiers"][tier]
        families, version = list(table["families"]), int(table["version"])
        number = list(table["axes"]).index(axis)
        sequences = []
        for k in range(int(size["count"])):
            width, height = size["sizes"][k % len(size["sizes"])]
            options = {
                **table.get("common", {}),
                **what["options"],
                "seed": int(part["seed"]) + int(what["seed"]) + int(size["seed"]) + k,
                "family": what.get("families", families)[(number + k) % len(what.get("families", families))],
                "frames": round(size["seconds"] * size["fps"]),
                "fps": float(size["fps"]),
                "width": int(width),
                "height": int(height),
            }
            entry = {
                "name": "_".join([axis, split, *([tier] if tier != "mini" else []), str(k)]),
                "about": what["about"],
                "rendered": tuple(sorted({**options, "version": version}.items())),
            }
            if "judged_by" in what:
                entry["judged_by"] = what["judged_by"]
            sequences.append(entry)
        return {
            "name": "/".join([axis, *([split] if split != "validation" else []), *([tier] if tier != "mini" else [])]),
            "label": part["label"],
            "sequences": sequences,
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DvoError(f"a setting is missing or wrong ({error!r})", file=file, field=axis, remedy="fix it") from error


def choose(text: str, table: Table, group: str) -> list[tuple[str, str, str]]:
    """``NAME[/SPLIT][/TIER]`` to (axis, split, tier): of one axis, or of all if the name is that of the ``group``.

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
        if word in table["splits"]:
            split = word
        elif word in table["tiers"]:
            tier = word
        else:
            known = ", ".join([*table["splits"], *table["tiers"]])
            raise DvoError(f"no split or tier '{word}'", field="--suite", remedy=f"choose from {known}")
    return [(axis, split, tier) for axis in (table["axes"] if name == group else [name])]
