"""Settings of the study of the family."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from dvo.core.errors import DvoError
from dvo.core.settings import Range, from_table
from dvo.core.yaml_files import read_yaml
from train.tasks.registry import task_class

NULL = "null"
"""Row of the tables for a straight line at constant speed."""


@dataclass(frozen=True)
class Phase:
    """Part of the training of a member, with one cycle of the learning rate.

    Attributes:
        share: of the member's budget.
        rate: learning rate at its highest.
        settings: of the task and the engine, on top of those of the member.
    """

    RANGES: ClassVar[dict[str, Range]] = {"share": (0, 1), "rate": (0, 10)}

    share: float
    rate: float
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Member:
    """Member of the family: a network, its loss and its odometry.

    Attributes:
        task: registered name of the training task, or ``"module:Class"``.
        phases: parts of the training, one after the other; their shares add up to 1. Each starts from the weights of
            the one before.
        about: description in a few words.
        model: preset.
        batch: clips a step.
        steps: of all phases together, in place of the processor time; 0: the processor time is the budget.
        settings: of the task, common to the phases.
        odometry: single settings of the odometry.
    """

    RANGES: ClassVar[dict[str, Range]] = {"batch": (1, 10**4), "steps": (0, 10**9)}

    task: str
    phases: tuple[Phase, ...]
    about: str = ""
    model: str = "tiny"
    batch: int = 1
    steps: int = 0
    settings: dict[str, Any] = field(default_factory=dict)
    odometry: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class HeldOut:
    """Rendered sequences that the members are measured on.

    Attributes:
        seed: of the first one; the others follow.
        count: number of sequences.
        families, kinds: of scenes and of camera paths, taken in turn.
        frames: length.
        size: height and width, pixels.
        fps: frames a second.
        gaps: frames between the two of a pair whose relative pose is measured.
    """

    RANGES: ClassVar[dict[str, Range]] = {"seed": (0, 2**53), "count": (1, 1000), "frames": (3, 10**5)}

    seed: int = 3_500_000_000
    count: int = 6
    families: tuple[str, ...] = ("hall", "courtyard", "gallery")
    kinds: tuple[str, ...] = ("handheld",)
    frames: int = 60
    size: tuple[int, int] = (120, 160)
    fps: float = 7.5
    gaps: tuple[int, ...] = (1, 5)

    def sequences(self) -> dict[str, dict[str, Any]]:
        """Options of :func:`dvo.synth.make_sequence` by the name of the sequence; scenes that training cannot draw."""
        found = {}
        height, width = self.size
        for k in range(self.count):
            family, kind = self.families[k % len(self.families)], self.kinds[k % len(self.kinds)]
            found[f"{family}_{kind}_{k}"] = {
                "seed": self.seed + k, "family": family, "kind": kind, "frames": self.frames, "height": height,
                "width": width, "fps": self.fps, "apart": True,
            }  # fmt: skip
        return found


@dataclass(frozen=True)
class FamilyConfig:
    """Members and their common settings.

    Attributes:
        members: by name.
        folder: of clips, sequences and training states.
        out: of the page and the figure, without suffix; the measurements lie in the folder of that name.
        minutes: of the processor for the training of each member.
        seeds: of weights, draws and odometries; every member is trained with each of them.
        frames: length of a training clip.
        size: height and width of a training clip, pixels.
        flow: range of the mean induced flow between its frames, pixels.
        clips: number of training clips, the same for all members and seeds, used in turn.
        rise: share of a phase in which the learning rate rises.
        points: measurements of the learning curve after the one of the untrained network.
        curve_sequences: of the held-out sequences, for the learning curve.
        save_minutes: between training states, of the clock.
        held_out: sequences that the members are measured on.
        published: AUC at one degree of a published comparison, by name of the member.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "minutes": (1e-3, 1e5),
        "frames": (2, 1000),
        "clips": (1, 10**6),
        "rise": (0, 1),
        "points": (1, 1000),
        "curve_sequences": (0, 1000),
        "save_minutes": (1e-3, 1e5),
    }

    members: dict[str, Member]
    folder: str = "runs/train/family"
    out: str = "docs/family"
    minutes: float = 25.0
    seeds: tuple[int, ...] = (0, 1)
    frames: int = 6
    size: tuple[int, int] = (96, 128)
    flow: tuple[float, float] = (1.0, 10.0)
    clips: int = 1000
    rise: float = 0.05
    points: int = 10
    curve_sequences: int = 2
    save_minutes: float = 1.0
    held_out: HeldOut = field(default_factory=HeldOut)
    published: dict[str, float] = field(default_factory=dict)

    @classmethod
    def read(cls, file: Path) -> FamilyConfig:
        """Read a YAML file.

        Args:
            file: keys are the attributes of this class.

        Raises:
            DvoError: no such file; not valid YAML; or a setting that does not exist, of another type or out of range.
        """
        config = from_table(cls, read_yaml(file, "give configs/train/family.yaml"), file)
        lists: dict[str, tuple[Any, ...]] = {"seeds": config.seeds}
        lists |= {f"held_out: {name}": getattr(config.held_out, name) for name in ("families", "kinds", "gaps")}
        for name, values in lists.items():
            if not values:
                raise DvoError("an empty list", file=file, field=name, remedy="give one or more")
        if not config.members or NULL in config.members:
            raise DvoError("none, or one named 'null'", file=file, field="members", remedy="give other names")
        for name, member in config.members.items():
            if not math.isclose(sum(phase.share for phase in member.phases), 1.0, abs_tol=1e-6):
                remedy = "give one phase or more, with shares that add up to 1"
                raise DvoError("the shares do not add up to 1", file=file, field=f"members: {name}", remedy=remedy)
        return config

    def check_tasks(self, file: Path) -> None:
        """Check that the tasks of all members are there.

        Args:
            file: for messages.

        Raises:
            DvoError: a member whose task is not registered, or cannot be imported.
        """
        for name, member in self.members.items():
            try:
                task_class(member.task)
            except DvoError as error:
                remedy = f"{error.remedy}; or name the members to train with --members, or leave this one out"
                raise DvoError(error.message, file=file, field=f"members: {name}: task", remedy=remedy) from error

    def digest(self, name: str) -> str:
        """Fingerprint of everything that the measurements of a member depend on; of the sequences alone for ``null``.

        Args:
            name: of the member, or :data:`NULL`.
        """
        content: dict[str, Any] = {"held_out": asdict(self.held_out)}
        if name != NULL:
            member = asdict(self.members[name])
            trained = ("frames", "size", "flow", "clips", "rise", *([] if member["steps"] else ["minutes"]))
            content |= {key: getattr(self, key) for key in trained}
            content["member"] = {key: value for key, value in member.items() if key != "about"}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]
