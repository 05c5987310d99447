"""Folder of the recordings with which dvo is developed and evaluated."""

from __future__ import annotations

import os
from pathlib import Path

from dvo.core.errors import DvoError

VARIABLE = "DVO_DATA"
"""Environment variable that names the folder."""

_CHECKOUT = Path(__file__).resolve().parents[3]


def data_root(given: Path | str | None = None, *, required: bool = True) -> Path:
    """Folder of the recordings: the argument, else ``$DVO_DATA``, else ``../shared/data`` beside the checkout.

    Args:
        given: folder that the user named; None or empty for none.
        required: whether the folder has to exist.

    Returns:
        The folder; with ``required=False`` it need not exist.

    Raises:
        DvoError: ``required``, and there is no such folder.

    Example:
        >>> data_root("/data/recordings", required=False).name
        'recordings'
    """
    path = Path(given or os.environ.get(VARIABLE) or _CHECKOUT.parent / "shared" / "data")
    if required and not path.is_dir():
        raise DvoError("no such data folder", file=path, field="--data", remedy=f"set {VARIABLE} or give --data DIR")
    return path
