"""Interval of a recording: from a first frame to before another, by times or by numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np

from dvo.core.errors import DvoError

Item = TypeVar("Item", bound=tuple[Any, ...])
Bound = float | str
"""Seconds since the first frame, or the number of a frame as ``"120f"``."""

_ROUNDING = 1e-6  # seconds; times such as 0.1 + 0.2 are those that were meant
_LARGEST = 1e12
_REMEDY = "give seconds since the first frame, such as 2.5, or the number of a frame, such as 120f"


@dataclass(frozen=True)
class Interval:
    """Interval of a recording, with its start and without its end.

    Attributes:
        start, end: seconds since the first frame (float), or numbers of frames from 0 (int); None: no bound.

    Example:
        >>> Interval.of("0.5", "120f")
        Interval(start=0.5, end=120)
    """

    start: float | int | None = None
    end: float | int | None = None

    @classmethod
    def of(cls, start: Bound | None, end: Bound | None) -> Interval:
        """Check bounds.

        Args:
            start, end: as given by the user.

        Raises:
            DvoError: no bound, or an end that is not behind the start.
        """
        first, last = _bound(start, "start"), _bound(end, "end")
        if last is not None and last == 0:
            raise DvoError("an interval that ends at 0 is empty", field="end", remedy="give a later end")
        if first is not None and last is not None and type(first) is type(last) and last <= first:
            message = f"the interval from {start} to {end} is empty"
            raise DvoError(message, field="end", remedy="give an end behind the start")
        return cls(first, last)

    def __bool__(self) -> bool:
        return self.start is not None or self.end is not None

    def __str__(self) -> str:
        names = (f"{b:g} s" if isinstance(b, float) else f"frame {b}" for b in (self.start, self.end) if b is not None)
        return f"{'from' if self.start is not None else 'to'} {' to '.join(names)}"

    def select(
        self, items: Iterable[Item], time: Callable[[Item], float | None], stride: int, file: object
    ) -> Iterator[Item]:
        """Choose the frames in the interval; what follows it is not read.

        Args:
            items: frames in order; the first element of each is its number.
            time: of a frame, seconds, None if unknown; not called unless a bound is in seconds. The time of the first
                frame counts as 0.
            stride: every how many-th frame of the interval is wanted.
            file: that is read, for messages.

        Yields:
            Every ``stride``-th frame from the start on.

        Raises:
            DvoError: there is an interval, and no frame in it.
        """
        is_timed = isinstance(self.start, float) or isinstance(self.end, float)
        origin: float | None = None
        begun = None if self.start is not None else 0  # number of the frame that the stride counts from
        found, number, elapsed = False, -1, math.nan
        for item in items:
            number = item[0]
            if is_timed:
                now = time(item)
                origin = now if origin is None else origin
                elapsed = math.nan if now is None or origin is None else now - origin
            if _reached(self.end, number, elapsed):
                break
            if begun is None and not _reached(self.start, number, elapsed):
                continue
            begun = number if begun is None else begun
            found = True
            if (number - begun) % stride == 0:
                yield item
        if self and not found:
            end = f"{number + 1} frames" + (f", {elapsed:.3f} s" if elapsed == elapsed else "")
            remedy = "give times or numbers of frames that it has (--start, --end)"
            raise DvoError(f"no frame {self}; read were {end}", file=file, field="start", remedy=remedy)


def expected_frames(interval: Interval, count: int | None, times: np.ndarray | None, file: object) -> int | None:
    """Number of frames of a recording in an interval; None if it is not known before they are read.

    Args:
        interval: that is read.
        count: of all frames; None if it is not known.
        times: ``(count,)`` seconds, of all frames; None if they are not known.
        file: of the recording, for messages.

    Raises:
        DvoError: none is in the interval.
    """
    if not interval:
        return count
    if times is not None:
        return sum(1 for _ in interval.select(enumerate(times.tolist()), lambda item: item[1], 1, file))
    if count is None or isinstance(interval.start, float) or isinstance(interval.end, float):
        return None
    return max(0, min(count, count if interval.end is None else int(interval.end)) - int(interval.start or 0))


def _reached(bound: float | int | None, number: int, elapsed: float) -> bool:
    if bound is None:
        return False
    return number >= bound if isinstance(bound, int) else elapsed >= bound - _ROUNDING


def _bound(given: Any, field: str) -> float | int | None:
    """Seconds as float, number of a frame as int."""
    if given is None:
        return None
    text = str(given).strip()
    if isinstance(given, str) and text[-1:] == "f" and text[:-1].isascii() and text[:-1].isdigit() and len(text) < 13:
        return int(text[:-1])
    if isinstance(given, str):
        try:
            given = float(text)
        except ValueError:
            raise DvoError(f"{text[:40]!r} is no time", field=field, remedy=_REMEDY) from None
    # A bare whole number is taken for seconds: numbers of frames have the suffix.
    if not isinstance(given, Real | Integral) or isinstance(given, bool) or not 0 <= float(given) <= _LARGEST:
        raise DvoError(f"{text[:40]} is no time from the first frame on", field=field, remedy=_REMEDY)
    return float(given)
