"""Record of what a network has been trained on, kept in training states and told by model cards."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Protocol, cast

from dvo.core.errors import DvoError
from dvo.models.weights import LoadedWeights

KEY = "provenance"
"""Entry of a training state."""
LICENCE = "MIT"
"""Licence of weights that have seen nothing but renderings with the textures that dvo brings."""


@dataclass(frozen=True)
class Material:
    """Source of a batch of clips.

    Attributes:
        recordings: names of the recordings that it is drawn from; empty: it is rendered.
        photographs: name of a folder of photographs that renderings are painted with; empty: those that dvo brings.
        other: name of clips of another kind, about which nothing is known; empty: there are none.
    """

    recordings: tuple[str, ...] = ()
    photographs: str = ""
    other: str = ""


class TellsMaterial(Protocol):
    """Data module that says what its clips are made of; see :class:`train.data.stream.ClipStream`."""

    def material(self, clip: int, processes: int) -> Material:
        """Source of the batch that holds a clip."""


@dataclass(frozen=True)
class Provenance:
    """Clips that a network has been trained on, over all legs.

    Attributes:
        rendered, recorded, other_clips: number of clips that were rendered, cut from recordings, or of another kind.
        recordings, photographs, other: names of what they come from, see :class:`Material`.
        start: name, SHA-256 and model card of the weights that training started from; empty: random weights.
    """

    rendered: int = 0
    recorded: int = 0
    other_clips: int = 0
    recordings: tuple[str, ...] = ()
    photographs: tuple[str, ...] = ()
    other: tuple[str, ...] = ()
    start: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of_weights(cls, weights: LoadedWeights) -> Provenance:
        """Provenance of a training that starts from a weights file."""
        info = weights.info
        start: dict[str, Any] = {"name": weights.name}
        if info is not None:
            start |= {"sha256": info.sha256, "card": info.card}
        return cls(start=start)

    @classmethod
    def of_state(cls, state: Mapping[str, Any]) -> Provenance:
        """Provenance in a training state; a state of the time before it was kept has seen renderings only."""
        kept = state.get(KEY)
        if kept is None:
            return cls(rendered=clips_seen(state) or 0)
        if not isinstance(kept, Mapping):
            raise _no_record(KEY)
        names = {item.name: type(getattr(cls(), item.name)) for item in fields(cls)}
        plain = {name: tuple(value) if isinstance(value, list) else value for name, value in dict(kept).items()}
        for name, value in plain.items():
            if name not in names or not isinstance(value, names[name]):
                raise _no_record(f"{KEY}: {name}")
        return cls(**plain)

    def to_dict(self) -> dict[str, Any]:
        """Plain containers, for a training state and for JSON."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    def after(self, clips: int, of: Material) -> Provenance:
        """Provenance after further clips."""
        if of.other:
            return replace(self, other_clips=self.other_clips + clips, other=_with(self.other, [of.other]))
        if of.recordings:
            names = _with(self.recordings, of.recordings)
            return replace(self, recorded=self.recorded + clips, recordings=names)
        painted = _with(self.photographs, [of.photographs] if of.photographs else [])
        return replace(self, rendered=self.rendered + clips, photographs=painted)

    def data(self) -> str:
        """Sentence of the model card on the training data."""
        if self.rendered and not (self.recorded or self.other_clips or self.photographs):
            return "renderings of dvo.synth only"
        painted = f", painted with photographs of {', '.join(self.photographs)}" if self.photographs else ""
        parts = [
            (self.rendered, f"renderings of dvo.synth{painted}"),
            (self.recorded, f"recordings {', '.join(self.recordings)}"),
            (self.other_clips, f"clips of {', '.join(self.other)}"),
        ]
        return "; ".join(f"{name} ({count:,} clip{'s' * (count > 1)})" for count, name in parts if count) or "none"

    def licence(self) -> str:
        """Licence of the weights as far as it is known: that of the code, unless data or starting weights decide."""
        theirs = str(self.start.get("card", {}).get("licence", "not known")) if self.start else LICENCE
        limits = [
            (self.recorded, "the recordings allow"),
            (self.photographs, "the photographs allow"),
            (self.other_clips, "the training data allow"),
            (theirs != LICENCE, f"the starting weights allow ({theirs})"),
        ]
        said = [limit for holds, limit in limits if holds]
        return f"as {' and '.join(said)}" if said else LICENCE

    def facts(self) -> dict[str, Any]:
        """Entries of the model card."""
        found: dict[str, Any] = {"licence": self.licence(), "data": self.data()}
        if self.rendered:
            found["rendered_clips"] = self.rendered
        if self.recorded:
            found |= {"recorded_clips": self.recorded, "recordings": list(self.recordings)}
        if self.start:
            found["started_from"] = self.start
        return found


def clips_seen(state: Mapping[str, Any]) -> int | None:
    """Position in the clips that a training state holds; None without one.

    Raises:
        DvoError: a position that is no number.
    """
    streams = (value for value in state.values() if isinstance(value, Mapping))
    found = next((stream["clips_seen"] for stream in streams if "clips_seen" in stream), None)
    if found is not None and (isinstance(found, bool) or not isinstance(found, int)):
        raise _no_record("clips_seen")
    return found


def _no_record(field: str) -> DvoError:
    """Error of a training state whose record has another form."""
    remedy = "give a checkpoint that 'python -m train fit' wrote"
    return DvoError("is no training state", field=field, remedy=remedy)


def material_of(data: object, clip: int, processes: int) -> Material:
    """Source of the batch that holds a clip.

    Args:
        data: data module of the run; one without the method ``material`` gives clips of another kind.
        clip: index.
        processes: number of training processes.
    """
    if hasattr(data, "material"):
        return cast(TellsMaterial, data).material(clip, processes)
    return Material(other=type(data).__name__)


def names_of(folders: Iterable[str]) -> tuple[str, ...]:
    """Names of folders for model cards: the last part of each, and as many before it as tell them apart."""
    paths = [Path(folder).resolve().parts for folder in dict.fromkeys(folders)]
    count = 1
    while len({path[-count:] for path in paths}) < len(set(paths)):
        count += 1
    return tuple("/".join(path[-count:]) for path in paths)


def _with(names: tuple[str, ...], more: Iterable[str]) -> tuple[str, ...]:
    return tuple(sorted({*names, *more}))
