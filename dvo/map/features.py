"""Feature maps of archived keyframes, computed on demand and kept in a bounded cache."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.map.archive import ArchivedKeyframe


class FeatureCache:
    """Least-recently-used cache of feature maps by keyframe.

    Args:
        encode: feature maps of an image ``(H, W, 3)`` uint8 RGB.
        capacity: number of keyframes whose maps are kept.

    Raises:
        DvoError: a capacity below 1.
    """

    def __init__(self, encode: Callable[[np.ndarray], Tensor], capacity: int = 8) -> None:
        if capacity < 1:
            raise DvoError(f"must be 1 or more, got {capacity}", field="capacity", remedy="keep at least one keyframe")
        self.encode, self.capacity = encode, capacity
        self._maps: OrderedDict[int, Tensor] = OrderedDict()

    def __len__(self) -> int:
        return len(self._maps)

    def clear(self) -> None:
        """Release all maps."""
        self._maps.clear()

    def has(self, keyframe: ArchivedKeyframe) -> bool:
        """Return True if the maps of a keyframe are in the cache."""
        return keyframe.identifier in self._maps

    def put(self, keyframe: ArchivedKeyframe, maps: Tensor) -> None:
        """Give the maps of a keyframe that are known already.

        Args:
            keyframe: in the form of an archived one.
            maps: output of ``encode`` for its working image.
        """
        self._maps[keyframe.identifier] = maps

    def drop(self, keyframe: ArchivedKeyframe) -> None:
        """Release the maps of a keyframe, if they are there."""
        self._maps.pop(keyframe.identifier, None)

    def maps(self, keyframe: ArchivedKeyframe) -> Tensor | None:
        """Feature maps of a keyframe, from the cache or computed.

        Args:
            keyframe: of an archive.

        Returns:
            Output of ``encode`` for the working image; None if the image was not kept or has been released.
        """
        identifier = keyframe.identifier
        if identifier not in self._maps:
            image = keyframe.image()
            if image is None:
                return None
            self._maps[identifier] = self.encode(image)
        self._maps.move_to_end(identifier)
        while len(self._maps) > self.capacity:
            self._maps.popitem(last=False)
        return self._maps[identifier]
