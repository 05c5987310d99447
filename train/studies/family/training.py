"""Training of a member of the family within its budget, phase by phase, resumed where it was interrupted."""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch

from dvo.data.files.output import replaced
from dvo.metrics.relative_pose import recall_area
from dvo.models.weights import LoadedWeights
from dvo.odometry.load import build_odometry
from dvo.session.results import peak_memory_mb
from train.engine.program import TrainingProgram
from train.studies.clips import DiskClips, StudyClips
from train.studies.family.config import FamilyConfig, Member, Phase
from train.studies.family.evaluation import held_out_sequence, measure
from train.studies.family.pace import Budget, Pace
from train.studies.family.records import Records
from train.studies.training import fit, task_program
from train.validation.watch import undisturbed

CLIP_SEED = 61  # of the stream of training clips


@dataclass(frozen=True)
class Progress:
    """Training so far.

    Attributes:
        steps, clips, skipped: numbers of steps, of clips that they saw, and of steps that were not finite.
        seconds: of the processor.
    """

    steps: int = 0
    clips: int = 0
    skipped: int = 0
    seconds: float = 0.0


def run_folder(config: FamilyConfig, name: str, seed: int) -> Path:
    """Folder of the training states of a run; another one whenever its settings are others."""
    return Path(config.folder) / f"{name}_seed{seed}_{config.digest(name)}"


def sequence_folder(config: FamilyConfig, name: str) -> Path:
    """Folder of a held-out sequence."""
    form = config.held_out
    size = f"{form.frames}x{form.size[0]}x{form.size[1]}_{form.fps:g}"
    return Path(config.folder) / "sequences" / f"{name}_{form.seed}_{size}"


def training_clips(config: FamilyConfig) -> DiskClips:
    """Training clips of all members and seeds."""
    return DiskClips(Path(config.folder) / "clips", CLIP_SEED, config.clips, config)


def member_program(member: Member, phase: Phase, seed: int) -> TrainingProgram:
    """Training program of a phase; its learning rate is constant until :class:`Pace` sets it.

    Args:
        member: gives task and common settings.
        phase: gives further settings.
        seed: of the task's draws.

    Raises:
        DvoError: no such task, or a setting that it does not have.
    """
    common = {"model": member.model, "seed": seed}
    settings = member.settings | phase.settings | {"learning_rate": phase.rate, "warmup": 1}
    return task_program(member.task, common, **settings)


def build_member(program: TrainingProgram, member: Member, name: str, seed: int) -> Any:
    """Odometry of the averaged weights of a program."""
    weights = LoadedWeights.of(copy.deepcopy(program.average).eval(), name)
    return build_odometry(weights, seed=seed, **member.odometry)


class LearningCurve:
    """Observer that measures the odometry of the averaged weights at even shares of a member's budget.

    In a phase that goes on from a training state, the points that the table has are left out. Training sees nothing of
    a measurement: no random number is drawn from its states, and the time lies between two steps.

    Args:
        config: of the study.
        name, seed: of the run.
        offset, share: of the phase in the budget of the member.
        before: progress of the phases before.
        resumed: the phase goes on from a training state.
    """

    def __init__(
        self, config: FamilyConfig, name: str, seed: int, offset: float, share: float, before: Progress, resumed: bool
    ) -> None:
        self.config, self.name, self.seed = config, name, seed
        self.offset, self.part, self.before = offset, share, before
        self.records = Records(config)
        wanted = [name, str(seed)]
        rows = [row for row in self.records.curves.rows() if [row["member"], row["seed"]] == wanted] if resumed else []
        self.known = {(int(row["point"]), row["sequence"]) for row in rows}
        self.next = 0 if before.steps == 0 else int(offset * config.points + 1e-6) + 1
        self._clips: dict[str, Any] = {}

    def __call__(self, program: TrainingProgram, share: float, steps: int, seconds: float) -> None:
        """Measure if the next point is reached.

        Args:
            program: with the averaged weights.
            share: of the budget of the phase.
            steps, seconds: of the phase.
        """
        point = int((self.offset + share * self.part) * self.config.points + 1e-6)
        if point < self.next:
            return
        self.next = point + 1
        names = list(self.config.held_out.sequences())[: self.config.curve_sequences]
        for sequence in names:
            if (point, sequence) not in self.known:
                with undisturbed():
                    self._measure(program, sequence, point, self.before.steps + steps, self.before.seconds + seconds)

    def _measure(self, program: TrainingProgram, sequence: str, point: int, step: int, seconds: float) -> None:
        form = self.config.held_out
        if sequence not in self._clips:
            options = form.sequences()[sequence]
            self._clips[sequence] = held_out_sequence(sequence_folder(self.config, sequence), options)
        frames, truth = self._clips[sequence]
        odometry = build_member(program, self.config.members[self.name], self.name, self.seed)
        found = measure(odometry, frames, truth, form.gaps)
        self.records.curves.append(
            member=self.name, seed=self.seed, point=point, sequence=sequence, digest=self.config.digest(self.name),
            step=step, seconds=float(seconds), auc_10=recall_area(found.pooled, [10.0])[10.0],
            rotation_ratio=found.metrics.rotation_error_ratio, posed=found.metrics.matched,
        )  # fmt: skip


def train_member(config: FamilyConfig, name: str, seed: int) -> TrainingProgram:
    """Train a member, or load the weights of a run that is done.

    Args:
        config: of the study.
        name: of the member.
        seed: of weights and draws.

    Returns:
        Program with the final weights. The table of runs has a row of the run.
    """
    member, folder, records = config.members[name], run_folder(config, name, seed), Records(config)
    progress, offset, state = Progress(), 0.0, None
    trained = not records.trained(name, seed)  # in this call
    program = member_program(member, member.phases[0], seed)
    for number, phase in enumerate(member.phases):
        done = folder / f"phase{number}.pt"
        torch.manual_seed(seed)
        program = member_program(member, phase, seed)
        if state is not None:
            program.net.load_state_dict(state["net"])
            program.average.load_state_dict(state["net"])
        if not done.is_file():
            trained = True
            found = _train_phase(config, name, seed, program, number, offset, progress)
            content = {"net": program.net.state_dict(), "average": program.average.state_dict()}
            _save(content | {"progress": asdict(found)}, done)
        state = torch.load(done, weights_only=True)
        progress, offset = Progress(**state["progress"]), offset + phase.share
    assert state is not None
    program.net.load_state_dict(state["net"])
    program.average.load_state_dict(state["average"])
    if trained:
        memory = peak_memory_mb()
        records.runs.append(
            member=name, seed=seed, digest=config.digest(name),
            parameters=sum(p.numel() for p in program.net.parameters()), **asdict(progress),
            memory_mb=float("nan") if memory is None else memory,
        )  # fmt: skip
    return program


def _train_phase(
    config: FamilyConfig, name: str, seed: int, program: TrainingProgram, number: int, offset: float, before: Progress
) -> Progress:
    member = config.members[name]
    phase = member.phases[number]
    steps = max(1, round(phase.share * member.steps)) if member.steps else 0
    folder = run_folder(config, name, seed) / f"phase{number}"
    curve = LearningCurve(config, name, seed, offset, phase.share, before, (folder / "last.ckpt").is_file())
    pace = Pace(Budget(60 * config.minutes * phase.share, steps), phase.rate, config.rise, curve)
    stream = StudyClips(training_clips(config), member.batch, before.clips)
    fit(folder, program, stream, steps or -1, [pace], timedelta(minutes=config.save_minutes))
    taken = int(program.trainer.global_step)  # the pace counts none if the state had taken them all
    if pace.budget.share(taken, pace.train_seconds) < 1:  # ended from outside
        raise KeyboardInterrupt
    return Progress(
        before.steps + taken, stream.clips_seen, before.skipped + int(program.skipped),
        before.seconds + pace.train_seconds,
    )  # fmt: skip


def _save(content: dict[str, Any], file: Path) -> None:
    with replaced(file) as part, part.open("wb") as stream:
        torch.save(content, stream)
