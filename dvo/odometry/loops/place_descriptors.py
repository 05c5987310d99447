"""Descriptors of images for the recognition of places, from the matching features of the tracker's network.

The feature map is averaged over a coarse grid of cells. The averages are centred, and projected on the principal
directions of averages of pictures of many scenes with partial whitening (Jegou and Chum, Negative evidences and
co-occurrences in image retrieval, ECCV 2012; here to the power 1/2, that is, divided by the fourth root of the
variance). The grid keeps the layout of the view: it recognises places that are seen again from about the same
viewpoint, which is also where a geometric check can succeed. A turn of the camera by up to one column of cells is
covered by searching with the shifted descriptor as well (:meth:`PlaceDescriptor.views`).

``python -m train places`` fits the shipped mean and projection; docs/loops.md compares with other descriptors.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.data.files.output import replaced

PLACE_DESCRIPTORS = Registry(
    "place descriptor", "dvo.place_descriptors", {"grid": "dvo.odometry.loops.place_descriptors:shipped_descriptor"}
)
"""Names to ``"module:builder"``. A builder takes the number of channels of the network's matching features, and gives a
:class:`PlaceDescriptor`, or None where it has none for them: then loops are found from the poses alone."""
SHIPPED = Path(__file__).resolve().parents[2] / "weights" / "places" / "small.safetensors"
GRID = (3, 4)
"""Rows and columns of cells."""
MIN_LENGTH = 1e-6
"""Length below which a vector counts as zero."""


class PlaceDescriptor(Protocol):
    """Descriptor of an image for :class:`dvo.map.places.PlaceIndex`."""

    @property
    def name(self) -> str:
        """Name, for tables and files."""
        ...

    @property
    def dimensions(self) -> int:
        """Length of a descriptor."""
        ...

    def __call__(self, image: np.ndarray, maps: Tensor) -> np.ndarray:
        """Describe an image.

        Args:
            image: ``(H, W, 3)`` uint8 RGB working image.
            maps: ``(1, 1, C, h, w)`` its matching features, see :func:`dvo.odometry.frames.front_end.encode_image`.

        Returns:
            ``(dimensions,)`` float32 unit vector; zeros for an image that cannot be described.
        """
        ...

    def views(self, descriptor: np.ndarray) -> np.ndarray:
        """Variants of a descriptor to search with.

        Args:
            descriptor: ``(dimensions,)``.

        Returns:
            ``(views, dimensions)``, the descriptor itself first, none longer than a unit vector.
        """
        ...


@dataclass(frozen=True)
class GridDescriptor:
    """Whitened averages of the matching features over a grid of cells; the default :class:`PlaceDescriptor`.

    Attributes:
        mean: ``(rows, columns, C)`` float32 mean of the averages of each cell.
        projection: ``(C, c)`` float32.
    """

    mean: np.ndarray
    projection: np.ndarray

    @property
    def name(self) -> str:
        """Name with the numbers of cells."""
        return f"grid {self.mean.shape[0]}x{self.mean.shape[1]}"

    @property
    def dimensions(self) -> int:
        """Cells times projected channels."""
        return self.mean.shape[0] * self.mean.shape[1] * self.projection.shape[1]

    def __call__(self, image: np.ndarray, maps: Tensor) -> np.ndarray:
        """Describe an image; see :class:`PlaceDescriptor`.

        Args:
            image: not used.
            maps: ``(1, 1, C, h, w)`` matching features.

        Returns:
            ``(dimensions,)`` float32 unit vector.

        Raises:
            DvoError: features of another network.
        """
        rows, columns, _ = self.mean.shape
        return describe_cells(pool_cells(maps, (rows, columns)), self)

    def views(self, descriptor: np.ndarray) -> np.ndarray:
        """Descriptor as it is, and moved by one column of cells to either side with zeros in the column that is free.

        The inner product with another descriptor then counts only what both would see.

        Args:
            descriptor: ``(dimensions,)``.

        Returns:
            ``(3, dimensions)``.
        """
        rows, columns, _ = self.mean.shape
        cells = np.asarray(descriptor, np.float32).reshape(rows, columns, -1)
        found = np.zeros((3, *cells.shape), np.float32)
        found[0] = cells
        found[1, :, 1:] = cells[:, :-1]
        found[2, :, :-1] = cells[:, 1:]
        return found.reshape(3, -1)


def pool_cells(maps: Tensor, grid: tuple[int, int] = GRID) -> np.ndarray:
    """Average feature maps over the cells of a grid.

    Args:
        maps: ``(1, 1, C, h, w)``.
        grid: rows and columns.

    Returns:
        ``(rows, columns, C)`` float32.
    """
    return adaptive_avg_pool2d(maps[0, 0].detach().float(), grid).permute(1, 2, 0).cpu().numpy()


def describe_cells(cells: np.ndarray, fitted: GridDescriptor) -> np.ndarray:
    """Descriptor from averages: centring, projection, and lengths.

    The vector of each cell is divided by the square root of its length, so that cells of strong contrast do not decide
    alone; then the whole is scaled to a unit vector.

    Args:
        cells: ``(rows, columns, C)``.
        fitted: mean and projection.

    Returns:
        ``(rows * columns * c,)`` float32.

    Raises:
        DvoError: another number of channels.
    """
    if cells.shape != fitted.mean.shape:
        raise DvoError(
            f"features of shape {cells.shape}, fitted for {fitted.mean.shape}", field="maps",
            remedy="fit a descriptor to this network: python -m train places",
        )  # fmt: skip
    projected = (cells - fitted.mean) @ fitted.projection
    lengths = np.linalg.norm(projected, axis=-1, keepdims=True)
    vector = (projected / np.sqrt(np.maximum(lengths, MIN_LENGTH))).ravel()
    length = float(np.linalg.norm(vector))
    return (vector / length if length > MIN_LENGTH else np.zeros_like(vector)).astype(np.float32)


def fit_grid(cells: np.ndarray, channels: int = 32) -> GridDescriptor:
    """Fit mean and projection.

    Args:
        cells: ``(N, rows, columns, C)`` averages of pictures of many scenes.
        channels: principal directions that are kept, the same ones for all cells.

    Returns:
        The descriptor; the sign of each direction is that which makes its largest entry positive.

    Raises:
        DvoError: fewer vectors than channels, or more directions than channels.
    """
    count = int(np.prod(cells.shape[:-1]))
    if not 1 <= channels <= min(cells.shape[-1], count - 1):
        raise DvoError(f"{channels} of {cells.shape[-1]}, from {count}", field="channels", remedy="give fewer")
    mean = cells.astype(np.float64).mean(0)
    centred = (cells - mean).reshape(count, -1)
    variances, directions = np.linalg.eigh(centred.T @ centred / count)
    variances, directions = variances[::-1][:channels], directions[:, ::-1][:, :channels]
    signs = np.sign(directions[np.abs(directions).argmax(0), np.arange(channels)])
    projection = signs * directions / np.maximum(variances, variances[0] * 1e-9) ** 0.25
    return GridDescriptor(mean.astype(np.float32), projection.astype(np.float32))


def save_descriptor(file: Path | str, fitted: GridDescriptor, facts: dict[str, Any]) -> None:
    """Write a fitted descriptor.

    Args:
        file: safetensors file; its folder is made if need be.
        fitted: mean and projection.
        facts: on its origin, JSON-able.

    Raises:
        DvoError: a file that cannot be written.
    """
    try:
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        # Arrays in Fortran order would be written with their entries in another order.
        arrays = {name: np.ascontiguousarray(getattr(fitted, name)) for name in ("mean", "projection")}
        with replaced(file) as part:
            save_file(arrays, part, {"facts": json.dumps(facts)})  # one key: several are written in any order
    except (OSError, SafetensorError) as error:
        raise DvoError(f"cannot be written ({error})", file=file, remedy="give a file in another folder") from error


def shipped_descriptor(channels: int) -> GridDescriptor | None:
    """Descriptor that ships with dvo.

    Args:
        channels: of the matching features of the network.

    Returns:
        The descriptor; None for a network with another number of channels.
    """
    found = load_descriptor()
    return found if found.mean.shape[2] == channels else None


def load_descriptor(file: Path | str = SHIPPED) -> GridDescriptor:
    """Read a fitted descriptor.

    Args:
        file: of :func:`save_descriptor`; that which is shipped for the weights ``small``, by default.

    Returns:
        The descriptor.

    Raises:
        DvoError: no such file, or another content.
    """
    remedy = "give a file of python -m train places"
    try:
        with safe_open(file, framework="np") as content:
            mean, projection = (content.get_tensor(name) for name in ("mean", "projection"))
    except (SafetensorError, OSError, ValueError) as error:
        raise DvoError(f"no descriptor of places ({error})", file=file, remedy=remedy) from error
    fits = mean.ndim == 3 and projection.ndim == 2 and mean.shape[2] == projection.shape[0]
    if not fits or not (np.isfinite(mean).all() and np.isfinite(projection).all()):
        raise DvoError("no descriptor of places", file=file, field="mean, projection", remedy=remedy)
    return GridDescriptor(mean.astype(np.float32), projection.astype(np.float32))
