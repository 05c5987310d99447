"""Picture of docs/architecture.md: the rooms of dvo, by their imports: python docs/rooms/make.py [--out FILE].

A room stands above all that it imports; its number is that of its lines. An arrow is an import that does not follow
from others: who imports `nets` may import `geometry` too. `core` is left out, which everybody imports, and what only
starts the command line.
"""

from __future__ import annotations

import argparse
import ast
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
LIBRARY = FOLDER.parents[1] / "dvo"
INNER = ("data", "odometry")
LEFT_OUT = {"core", "moved", "__init__", "__main__", "batch_worker"}
WIDTH, HEIGHT, GAP = 2.3, 0.62, 0.5


def modules() -> dict[str, Path]:
    """Files of the library by the names of their modules."""
    return {
        ".".join(("dvo", *file.relative_to(LIBRARY).with_suffix("").parts)).removesuffix(".__init__"): file
        for file in sorted(LIBRARY.rglob("*.py"))
    }


def imported(file: Path, known: dict[str, Path]) -> Iterator[Path]:
    """Files of the library that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (known[alias.name] for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                yield known.get(f"{node.module}.{alias.name}", known[node.module])


def arrows(room_of: Callable[[Path], str | None]) -> tuple[dict[str, set[str]], dict[str, int]]:
    """Rooms that each room imports, and their lines.

    Args:
        room_of: of a file; None for those that are left out.
    """
    known, taken, lines = modules(), defaultdict(set), defaultdict(int)
    for file in known.values():
        room = room_of(file)
        if room is None:
            continue
        lines[room] += len(file.read_text(encoding="utf-8").splitlines())
        taken[room] |= {other for target in imported(file, known) if (other := room_of(target)) not in (None, room)}
    return dict(taken), dict(lines)


def floors(taken: dict[str, set[str]]) -> list[list[str]]:
    """Rooms by floor, the ground first: each stands above all that it imports."""
    height: dict[str, int] = {}
    while len(height) < len(taken):
        free = [room for room in taken if room not in height and taken[room] <= height.keys()]
        assert free, "rooms stand in a circle"
        height |= {room: 1 + max((height[other] for other in taken[room]), default=-1) for room in free}
    return [sorted(room for room in taken if height[room] == k) for k in range(max(height.values()) + 1)]


def top_room(file: Path) -> str | None:
    """Room of a file in the whole library."""
    place = file.relative_to(LIBRARY).parts[0].removesuffix(".py")
    return None if place in LEFT_OUT else place


def inner_room(room: str) -> Callable[[Path], str | None]:
    """Rooms of the files inside of a room."""

    def find(file: Path) -> str | None:
        parts = file.relative_to(LIBRARY).parts
        place = parts[1].removesuffix(".py") if parts[0] == room else "__init__"
        return None if place == "__init__" else place

    return find


def without_shortcuts(taken: dict[str, set[str]]) -> dict[str, set[str]]:
    """Imports without those of rooms that another imported room reaches as well."""

    def reached(room: str) -> set[str]:
        return {room}.union(*(reached(other) for other in taken[room]))

    return {
        room: {one for one in others if not any(one in reached(other) for other in others - {one})}
        for room, others in taken.items()
    }


def draw_house(axes: Any, title: str, taken: dict[str, set[str]], lines: dict[str, int]) -> None:
    """Draw rooms on their floors, with an arrow for each import between them."""
    levels, centre = floors(taken), {}
    widest = max(map(len, levels))
    for k, rooms in enumerate(levels):
        for i, room in enumerate(rooms):
            centre[room] = ((i + 0.5) * widest / len(rooms) * (WIDTH + GAP), k * (HEIGHT + 1.3 * GAP))
    for room, others in without_shortcuts(taken).items():
        for other in others:
            (x, y), (u, v) = centre[room], centre[other]
            arrow = {"arrowstyle": "->", "color": "0.45", "alpha": 0.8, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", (u, v + HEIGHT / 2), (x, y - HEIGHT / 2), arrowprops=arrow)
    for room, (x, y) in centre.items():
        box = {"boxstyle": "round,pad=0.35", "fc": "white", "ec": "0.2", "lw": 1.0}
        axes.text(x, y, f"{room}\n{lines[room]:,}", ha="center", va="center", fontsize=8, bbox=box)
    axes.set_title(title, fontsize=10)
    axes.set_xlim(0, widest * (WIDTH + GAP))
    axes.set_ylim(-HEIGHT, (len(levels) - 1) * (HEIGHT + 1.3 * GAP) + HEIGHT)
    axes.axis("off")


def main() -> None:
    """Command line."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER / "rooms.png")
    options = parser.parse_args()
    figure, panels = pyplot.subplots(1, 3, figsize=(17, 9.5), gridspec_kw={"width_ratios": [4, 3.4, 4]})
    for axes, room in zip(panels, (None, *INNER), strict=True):
        draw_house(axes, room or "dvo", *arrows(top_room if room is None else inner_room(room)))
    figure.tight_layout()
    figure.savefig(options.out, dpi=90, metadata={"Software": None})
    print(options.out)


if __name__ == "__main__":
    main()
