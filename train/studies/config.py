"""Settings of a study."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from dvo.core.errors import DvoError
from dvo.core.settings import Range, from_table
from dvo.core.yaml_files import read_yaml
from train.tasks.registry import DEFAULT_TASK


@dataclass(frozen=True)
class StudyConfig:
    """Arms of a study and their common settings.

    Attributes:
        folder: of clips and runs.
        out: of the table and the curves, without suffix.
        title, about: heading and first paragraph of the report.
        task: registered name of a training task, or ``"module:Class"``.
        model: preset.
        frames: length of a clip.
        size: height and width of a clip, pixels.
        flow: range of the mean induced flow between frames, pixels.
        updates: updates a clip.
        settings: further settings of the task, common to start and arms.
        start: settings of the task for the start that all arms of a seed share; for ``patch_vo`` they train the flow
            head alone.
        start_steps: length of the start, steps.
        start_rate: learning rate of the start.
        state: training state whose weights all arms start from, in place of the shared start; empty for none. It is of
            the size ``model``.
        steps: steps of an arm, one OneCycle.
        rates: learning rates; every arm is run with each of them.
        seeds: every arm is run with each of them.
        clips: rendered clips a seed, used in turn.
        validate_every: steps between measurements of the validation error.
        validation_clips: held-out clips of a measurement.
        base: settings of the loss that all arms share.
        arms: name to settings of the loss.
        arm_settings: name of an arm to settings of the task that are its own.
        clip_options: further options of the clips (:func:`dvo.synth.clip.make_clip`), held-out ones included.
        arm_clips: name of an arm to options of its training clips that are its own.
        measures: name of a measure of the task to the label of its curves; the report compares by the first one, and
            names the second beside it.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "frames": (2, 1000),
        "updates": (1, 1000),
        "start_steps": (0, 10**9),
        "start_rate": (0, 10),
        "steps": (1, 10**9),
        "clips": (1, 10**6),
        "validate_every": (1, 10**9),
        "validation_clips": (1, 10**5),
    }

    folder: str = "runs/train/study"
    out: str = "docs/v2v_study"
    title: str = "V2V on a small scale"
    about: str = (
        "Does weighting the flow loss by the confidence, and balancing it against the pose loss, make training faster "
        "or better?\nThe pose error is translation in median depths plus rotation in radians over all pairs of frames; "
        "the shared steps train\nthe flow head alone."
    )
    task: str = DEFAULT_TASK
    model: str = "tiny"
    frames: int = 6
    size: tuple[int, int] = (96, 128)
    flow: tuple[float, float] = (1.0, 10.0)
    updates: int = 6
    settings: dict[str, Any] = field(default_factory=dict)
    start: dict[str, Any] = field(default_factory=lambda: {"warmup_until": 2.0, "loss": {"target": 1.0}})
    start_steps: int = 300
    start_rate: float = 2e-3
    state: str = ""
    steps: int = 1000
    rates: tuple[float, ...] = (4e-4, 2e-3)
    seeds: tuple[int, ...] = (0, 1, 2)
    clips: int = 500
    validate_every: int = 100
    validation_clips: int = 24
    base: dict[str, Any] = field(default_factory=lambda: {"pose": 10.0, "flow": 0.1, "target": 0.0})
    arms: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {
            "DPVO": {},
            "V2V weighting": {"weighted": True},
            "V2V weighting + balance": {"weighted": True, "balance": "v2v"},
        }
    )
    arm_settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    clip_options: dict[str, Any] = field(default_factory=dict)
    arm_clips: dict[str, dict[str, Any]] = field(default_factory=dict)
    measures: dict[str, str] = field(
        default_factory=lambda: {
            "pose": "pose error (median depths + rad)",
            "rotation_ratio": "rotation error / motion",
        }
    )

    def __post_init__(self) -> None:
        for name in ("arm_settings", "arm_clips"):
            unknown = set(getattr(self, name)) - set(self.arms)
            if unknown:
                raise DvoError(
                    f"no such arm: {', '.join(sorted(unknown))}", field=name, remedy="name one that stands under arms"
                )

    @classmethod
    def read(cls, file: Path) -> StudyConfig:
        """Read a YAML file.

        Args:
            file: keys are the attributes of this class.

        Raises:
            DvoError: no such file; not valid YAML; or a setting that does not exist, of another type or out of range.
        """
        table = read_yaml(file, "give configs/train/study.yaml")
        return from_table(cls, {} if table is None else table, file)
