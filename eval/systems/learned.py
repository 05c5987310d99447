"""Version and availability of the learned odometry, by its weights."""

from __future__ import annotations

import dvo
from dvo.core.errors import DvoError


def version(weights: str) -> str:
    """Version of dvo and the first eight digits of the hash of the weights.

    Args:
        weights: name of weights that ship with dvo, or a file.

    Raises:
        DvoError: no such weights.
    """
    from dvo.models.weights import weights_info

    return f"{dvo.__version__}+{weights_info(weights).sha256[:8]}"


def missing(weights: str) -> str | None:
    """Reason why the weights cannot be used, or None."""
    from dvo.models.weights import weights_info

    try:
        weights_info(weights)
    except DvoError as error:
        return str(error)
    return None
