"""Calibration of a camera from a video of a board."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.boards.board import Board
from dvo.boards.solve import NAMES, Solution, solve
from dvo.boards.views import Search, View, choose_views, find_views
from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from dvo.data.calibration.calibration import Calibration
from dvo.data.files.output import replaced
from dvo.data.frame import Frame
from dvo.geometry.undistort import Undistorter

_CELLS = (8, 6)  # columns and rows of the cells of the coverage
_TILT = "tilt the board by 30 to 45 degrees to the left, right, up and down, and show it near and in all corners"
_RANGES = {
    "frames": (1, 10**6),
    "views": (3, 1000),
    "min_views": (3, 1000),
    "outlier": (1.5, 1000),
    "max_deviation": (0, 10),
    "doubtful": (0, 10),
    "max_rms": (0, 1000),
}

HEADER = "# dvo calibrate"
"""First words of a calibration file."""


@dataclass(frozen=True)
class BoardOptions:
    """Options of :func:`calibrate_board`.

    Attributes:
        fisheye: lens model ``fisheye`` (Kannala-Brandt), else ``radtan``.
        k3: whether ``radtan`` has its third radial coefficient.
        frames: number of frames that are searched, about: of a longer clip the sharpest of each few frames.
        views: number of views to calibrate from, at most.
        min_views: smallest number.
        outlier: a view is rejected whose RMS is so many times the median of the views.
        max_deviation: standard deviation of the focal length over it, beyond which the views do not determine it.
        doubtful: the same, beyond which there is a warning.
        max_rms: reprojection error in pixels beyond which there is a warning.

    Raises:
        DvoError: a value of another type or out of range.
    """

    fisheye: bool = False
    k3: bool = False
    frames: int = 300
    views: int = 40
    min_views: int = 6
    outlier: float = 2.5
    max_deviation: float = 0.05
    doubtful: float = 0.005
    max_rms: float = 1.0

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)
        if self.fisheye and self.k3:
            raise DvoError("is always there with fisheye", field="k3", remedy="leave it out")


@dataclass(frozen=True)
class BoardCalibration:
    """Camera, with the views that it was found from.

    Attributes:
        board: its name.
        width, height: of the images, pixels.
        solution: parameters, poses, residuals.
        views: used, in the order of ``solution``.
        rejected: chosen, but with too large an error.
        found: number of frames with the board.
        examined: number of frames that were searched.
        coverage: share of the cells of the image (8x6) that hold a corner.
        warnings: doubts, a sentence each.
        example: ``(H, W, 3)`` uint8 image with the largest view of the board; its index is ``example_index``.
    """

    board: str
    width: int
    height: int
    solution: Solution
    views: tuple[View, ...]
    rejected: tuple[View, ...]
    found: int
    examined: int
    coverage: float
    warnings: tuple[str, ...]
    example: np.ndarray
    example_index: int

    @property
    def calibration(self) -> Calibration:
        """Calibration of the images, with their size."""
        fx, fy, cx, cy, *lens = (float(value) for value in self.solution.values)
        model = "fisheye" if self.solution.fisheye else "radtan"
        return Calibration(fx, fy, cx, cy, model, tuple(lens), self.width, self.height)  # type: ignore[arg-type]

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of each parameter by name."""
        names = NAMES[self.solution.fisheye][: len(self.solution.values)]
        pairs = zip(self.solution.values.tolist(), self.solution.deviations.tolist(), strict=True)
        return dict(zip(names, pairs, strict=True))

    def __str__(self) -> str:
        """Summary of a few lines."""
        tilts = self.solution.tilts
        used = f"{len(self.views)} views of a {self.board} ({self.found} found in {self.examined} frames"
        lines = [
            used + (f", {len(self.rejected)} rejected)" if self.rejected else ")"),
            "  ".join(f"{name} {value:.2f} +- {deviation:.2f}" for name, (value, deviation) in self._parts(0, 4)),
            "  ".join(f"{name} {value:.4f} +- {deviation:.4f}" for name, (value, deviation) in self._parts(4, None)),
            f"reprojection error {self.solution.rms:.3f} px (RMS); corners in {self.coverage:.0%} of the image; tilt "
            f"of the board {tilts.min():.0f} to {tilts.max():.0f} degrees",
        ]
        return "\n".join(lines)

    def _parts(self, start: int, stop: int | None) -> list[tuple[str, tuple[float, float]]]:
        return list(self.parameters.items())[start:stop]

    def write(self, file: Path | str) -> None:
        """Write a calibration file that :func:`dvo.data.calibration.read.read_calibration` reads.

        Args:
            file: text, ``fx fy cx cy k1 k2 p1 p2 [k3]``; a name that ends in ``.yaml`` for YAML, which a fisheye needs.

        Raises:
            OSError: it cannot be written.
            ValueError: a text file for a fisheye.
        """
        path = Path(file)
        head = "".join(
            f"# {line}\n" for line in (f"{HEADER[2:]}, {self.width}x{self.height} images", *str(self).split("\n"))
        )
        c = self.calibration
        pixels, lens = (c.fx, c.fy, c.cx, c.cy), ", ".join(f"{value:.9g}" for value in c.coefficients)
        if path.suffix.lower() in (".yaml", ".yml"):
            body = "".join(
                f"{name}: {value:.6f}\n" for name, value in zip(("fx", "fy", "cx", "cy"), pixels, strict=True)
            )
            body += f"width: {self.width}\nheight: {self.height}\nmodel: {c.model}\ncoefficients: [{lens}]\n"
        elif c.model == "fisheye":
            raise ValueError("a text file has no fisheye")
        else:
            body = " ".join(f"{value:.6f}" for value in pixels) + f" {lens.replace(',', '')}\n"
        with replaced(path) as part:
            part.write_text(head + body, encoding="utf-8")


def calibrate_board(
    frames: Iterable[Frame],
    board: Board,
    options: BoardOptions = BoardOptions(),  # noqa: B008 (frozen)
    *,
    name: str = "frames",
    on_frame: Callable[[int, int], None] | None = None,
) -> BoardCalibration:
    """Calibrate a camera from images of a board.

    Args:
        frames: as recorded, lens distortion included (``dvo.open(..., undistort=False, max_pixels=None)``); their
            cameras are not used.
        board: its geometry.
        options: lens model, number of views, and what is believed.
        name: of the source, for messages.
        on_frame: called after each search with the number of frames read and of views found.

    Returns:
        The camera with standard deviations; they take the errors of corners for independent, and the lens model for
        true.

    Raises:
        DvoError: no frames, no board, too few views, or views that do not determine the focal length.

    Example:
        >>> source = dvo.open("board.mp4", guess=True, undistort=False, max_pixels=None)
        >>> found = calibrate_board(source, Checkerboard(9, 6, 0.025))
        >>> found.write("calib.txt")
    """
    count = getattr(frames, "frame_count", None)
    every = 1 if count is None else max(1, -(-count // options.frames))
    search = find_views(frames, board, every, on_frame)
    _check_search(search, board, options, name)
    chosen = choose_views(search.views, options.views, search.width, search.height)
    solution, views = _without_outliers(chosen, search, board, options, name)
    tilts = solution.tilts
    relative = float((solution.deviations[:2] / solution.values[:2]).max())
    if not relative <= options.max_deviation:  # NaN fails too
        fx, deviation = solution.values[0], solution.deviations[0]
        raise DvoError(
            f"the views do not determine the focal length: {fx:.0f} +- {deviation:.3g} px; the tilt of the board "
            f"against the image is {tilts.min():.0f} to {tilts.max():.0f} degrees",
            file=name,
            remedy=_TILT,
        )
    assert search.example is not None
    left = {view.index for view in views}
    found = BoardCalibration(
        str(board), search.width, search.height, solution, tuple(views),
        tuple(view for view in chosen if view.index not in left), len(search.views), search.examined,
        _coverage(views, search.width, search.height), (), search.example, search.example_index,
    )  # fmt: skip
    doubts = _doubts(found, relative, options)
    return BoardCalibration(**{**vars(found), "warnings": tuple(doubts)})


def _check_search(search: Search, board: Board, options: BoardOptions, name: str) -> None:
    if search.examined == 0:
        raise DvoError("no frames", file=name, remedy="give a video or a folder with images")
    if not search.views:
        message = f"no {board} was found in {search.examined} frames"
        raise DvoError(message, file=name, remedy=board.hint(search.unseen))
    if len(search.views) < options.min_views:
        raise _too_few(len(search.views), search, board, options, name)


def _too_few(number: int, search: Search, board: Board, options: BoardOptions, name: str) -> DvoError:
    message = f"{number} usable views of the {board} in {search.examined} frames, {options.min_views} are needed"
    return DvoError(message, file=name, remedy="show the whole board slowly, in even light, from more directions")


def _without_outliers(
    chosen: list[View], search: Search, board: Board, options: BoardOptions, name: str
) -> tuple[Solution, list[View]]:
    """Solve, reject views with large errors, and solve again until none is left."""
    views = chosen
    while True:
        solution = solve(views, search.width, search.height, fisheye=options.fisheye, k3=options.k3)
        if solution is None:
            message = "no camera fits the views: the focal length is undetermined, or the board is another one"
            raise DvoError(message, file=name, remedy=f"check the size of the board; {_TILT}")
        errors = solution.view_rms
        good = errors <= max(options.outlier * float(np.median(errors)), 0.05)
        if good.all():
            return solution, views
        views = [view for view, keep in zip(views, good, strict=True) if keep]
        if len(views) < options.min_views:
            raise _too_few(len(views), search, board, options, name)


def _coverage(views: list[View], width: int, height: int) -> float:
    corners = np.concatenate([view.corners for view in views]) + 0.5
    inside = corners[((corners >= 0) & (corners < [width, height])).all(axis=1)]
    cells = np.unique((inside * _CELLS / [width, height]).astype(int), axis=0)
    return len(cells) / (_CELLS[0] * _CELLS[1])


def _doubts(found: BoardCalibration, relative: float, options: BoardOptions) -> list[str]:
    doubts = []
    if relative > options.doubtful:
        doubts.append(f"the focal length is known to {relative:.1%} only: {_TILT}")
    if found.coverage < 0.5:
        share = f"{found.coverage:.0%}"
        doubts.append(
            f"corners cover {share} of the image: outside of them the distortion is a guess; show the board there"
        )
    if found.solution.rms > options.max_rms:
        doubts.append(
            f"a reprojection error of {found.solution.rms:.1f} px is large: is the board flat, are the images sharp, "
            "is the lens a fisheye?"
        )
    try:
        camera = found.calibration.camera(found.width, found.height)
        if camera.needs_undistortion:
            Undistorter(camera)
    except DvoError as error:
        doubts.append(
            f"dvo run cannot use this calibration: {error.message}; show the board in all corners of the image"
        )
    return doubts
