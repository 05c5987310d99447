"""Streams in ``dvo run``: the counts of their frames."""

from __future__ import annotations

import time
from typing import Any

from dvo.commands.console import say
from dvo.data.source import Source
from dvo.data.streams.live_source import LiveSource


def stream_facts(source: Source) -> dict[str, Any]:
    """Entries of run.json about a stream.

    Args:
        source: any.

    Returns:
        ``live``: counts, which are updated while it runs; ``clock``: origin of the times, and for the monotonic clock
        the seconds to add for Unix time. Nothing for a recording that is no stream.
    """
    if not isinstance(source, LiveSource):
        return {}
    is_monotonic = source.times in ("arrival", "stream")
    to_unix = round(time.time() - time.monotonic(), 3) if is_monotonic else None
    return {"live": source.counts, "clock": {"times": source.times, "to_unix": to_unix}}


def print_counts(source: Source) -> None:
    """Print the numbers of frames of a stream.

    Args:
        source: any; nothing is printed for a recording that is no stream.
    """
    if isinstance(source, LiveSource):
        counts = source.counts
        say(f"received {counts.received} frames, dropped {counts.dropped} of them")
