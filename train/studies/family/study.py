"""Study of the learned family: every member trained from scratch for the same processor time, on the same clips.

``python -m train family`` trains each member of ``configs/train/family.yaml`` with each seed on one thread, measures
its odometry on held-out rendered sequences, and writes a page with a table and a figure. Every measurement is appended
to a table in CSV as soon as it is made; a run that is done is not run again, one that was interrupted goes on from its
last training state. ``--report`` prints page and figure again from the tables.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.text import print_line
from train.studies.family.config import NULL, FamilyConfig
from train.studies.family.evaluation import Measured, errors_of, held_out_sequence, measure, straight_line
from train.studies.family.process import apart
from train.studies.family.records import Records
from train.studies.family.training import build_member, sequence_folder, train_member, training_clips

CONFIG = Path("configs/train/family.yaml")


def render_sequences(config: FamilyConfig) -> None:
    """Render the held-out sequences that do not lie on disk."""
    for sequence, options in config.held_out.sequences().items():
        held_out_sequence(sequence_folder(config, sequence), options)


def render_clips(config: FamilyConfig) -> None:
    """Render the training clips that do not lie on disk."""
    clips = training_clips(config)
    for index in clips.missing():
        clips[index]


def train_run(config: FamilyConfig, name: str, seed: int) -> None:
    """Train a member; see :func:`train.studies.family.training.train_member`."""
    train_member(config, name, seed)


def evaluate_run(config: FamilyConfig, name: str, seed: int) -> None:
    """Measure a trained member on the held-out sequences that its tables lack.

    Args:
        config: of the study.
        name: of the member, or :data:`train.studies.family.config.NULL`.
        seed: of the run.
    """
    records, form = Records(config), config.held_out
    known = records.measured(name, seed)
    program = None
    for sequence, options in form.sequences().items():
        if sequence in known:
            continue
        frames, truth = held_out_sequence(sequence_folder(config, sequence), options)
        if name == NULL:
            found = errors_of(straight_line(truth), truth, form.gaps)
        else:
            program = program or train_member(config, name, seed)
            odometry = build_member(program, config.members[name], name, seed)
            found = measure(odometry, frames, truth, form.gaps)
        _record(records, found, name, seed, sequence)


def _record(records: Records, found: Measured, name: str, seed: int, sequence: str) -> None:
    """Rows of a sequence; that of the table of sequences comes last and says that the others are there."""
    run = {"member": name, "seed": seed, "sequence": sequence, "digest": records.config.digest(name)}
    for gap, errors in found.errors.items():
        records.pairs.append(**run, gap=gap, errors_deg=" ".join(f"{error:.4g}" for error in errors))
    records.sequences.append(**run, **found.columns())


def run_member(config: FamilyConfig, name: str, seed: int) -> None:
    """Train and measure a member, as far as that is not done.

    Args:
        config: of the study.
        name: of the member, or :data:`train.studies.family.config.NULL`.
        seed: of the run.
    """
    records = Records(config)
    if records.complete(name, seed):
        return
    if not all(sequence_folder(config, sequence).is_dir() for sequence in config.held_out.sequences()):
        apart(render_sequences, config)  # so that its memory is not that of training or tracking
    if name != NULL:
        if not records.trained(name, seed) and training_clips(config).missing():
            apart(render_clips, config)
        apart(train_run, config, name, seed)
    apart(evaluate_run, config, name, seed)


def rehearsal(config: FamilyConfig, seconds: float) -> FamilyConfig:
    """The study in short: one seed, one sequence and a few points of the learning curve, in a folder of its own.

    Args:
        config: of the study.
        seconds: of the processor for each member.
    """
    folder = f"{config.folder}_rehearsal_{seconds:g}s"
    return replace(
        config, folder=folder, out=f"{folder}/report", minutes=seconds / 60,
        seeds=config.seeds[:1], points=3, curve_sequences=1, clips=min(config.clips, 40),
        held_out=replace(config.held_out, count=1),
    )  # fmt: skip


def main(arguments: list[str]) -> None:
    """``python -m train family [--config FILE] [--members ...] [--seeds ...] [--rehearse SECONDS] [--report]``.

    Raises:
        DvoError: no such file, a setting that does not exist, a task that is not registered, or measurements that were
            made with other settings.
    """
    parser = OneLineParser(prog="python -m train family", description=__doc__.split("\n")[0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--members", nargs="+", metavar="NAME", help="train these alone; the page has all")
    parser.add_argument("--seeds", type=int, nargs="+")
    parser.add_argument(
        "--rehearse", type=float, metavar="SECONDS", help="of the processor a member; one seed and sequence, elsewhere"
    )
    parser.add_argument("--report", action="store_true", help="page and figure from the tables, without training")
    options = parser.parse_args(arguments)
    config = FamilyConfig.read(options.config)
    if options.rehearse is not None:
        if not options.rehearse > 0:
            raise DvoError(f"{options.rehearse:g} is too short", field="--rehearse", remedy="give seconds above 0")
        config = rehearsal(config, options.rehearse)
    names = options.members or list(config.members)
    unknown = [name for name in names if name not in config.members]
    if unknown:
        remedy = f"use {', '.join(config.members)}"
        raise DvoError(f"no member '{unknown[0]}'", file=options.config, field="--members", remedy=remedy)
    records = Records(config)
    records.check()
    if not options.report:
        replace(config, members={name: config.members[name] for name in names}).check_tasks(options.config)
        run_member(config, NULL, 0)
        for seed in options.seeds or config.seeds:
            for name in names:
                run_member(config, name, seed)
                print(f"{name}, seed {seed}: done", flush=True)
    from train.studies.family.report import write_report

    for file in write_report(records):
        print_line(str(file))
