"""Page and figure of the study of the family, from its tables."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path

from dvo.core.errors import DvoError
from train.studies.family.config import NULL, FamilyConfig
from train.studies.family.figure import draw
from train.studies.family.records import Records
from train.studies.family.summary import LIMITS, MemberSummary, summarise
from train.studies.report import WIDTH, row_text

FAR = "tartanvo"
"""Member that the published comparison has far behind on the ATE."""


def write_report(records: Records) -> list[Path]:
    """Write ``OUT.md`` and ``OUT.svg`` from the tables.

    Args:
        records: of the study.

    Returns:
        the files written.

    Raises:
        DvoError: no member is measured on all sequences.
    """
    config = records.config
    found = [summary for name in config.members if (summary := summarise(records, name)) is not None]
    if not found:
        remedy = "train the members first: python -m train family"
        raise DvoError("holds no complete run", file=records.sequences.file, remedy=remedy)
    null = summarise(records, NULL)
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    page, picture = out.with_suffix(".md"), out.with_suffix(".svg")
    draw(picture, records, found)
    page.write_text(page_text(config, found, null, picture.name), encoding="utf-8")
    return [page, picture]


def page_text(config: FamilyConfig, found: Sequence[MemberSummary], null: MemberSummary | None, picture: str) -> str:
    """Text of the page.

    Args:
        config: of the study.
        found: members that are measured.
        null: figures of the straight line.
        picture: name of the figure.
    """
    folder, height, width = Path(config.out).name, *config.size
    absent = [name for name in config.members if name not in [one.name for one in found]]
    blocks = [
        "# The learned family, trained for the same time",
        paragraph(
            f"""Members of the family trained from scratch at the size `tiny`, each for {config.minutes:.3g} minutes
            of one processor core, on the same {config.clips} rendered clips ({config.frames} frames of
            {width}x{height} pixels, mean flow {config.flow[0]:g} to {config.flow[1]:g} pixels a frame). Such
            networks are far from what longer training reaches: this page compares methods under a small budget, not
            the published systems. Printed by"""
        ),
        f"    python -m train family             trains and measures what the tables in `{folder}/` lack, then prints\n"
        "    python -m train family --report    prints from the tables",
        "\n".join(f"- `{one.name}`: {config.members[one.name].about}; {_phases(config, one.name)}" for one in found),
        *([paragraph(f"Not measured yet: {', '.join(absent)}.")] if absent else []),
        "## Results",
        results(found, null),
        paragraph(
            f"""Medians over the seeds, with their range in brackets, best AUC at 1° first. The row `{NULL}` is a
            straight line at constant speed, which uses no image. A dash in place of an error: there is no pose, or
            the estimate stands still. By distance of the frames of a pair:"""
        ),
        by_gap(config, found, null),
        *ranking(config, found),
        f"![learning curves, and recall of relative poses]({picture})",
        paragraph(
            f"""Left and middle: odometry of the averaged weights on {config.curve_sequences} of the sequences,
            while training goes on; lines are medians over the seeds, bands their range. Right: share of the pairs
            whose error is below a threshold, after training, all seeds together."""
        ),
        "## Method",
        *method(config),
    ]  # fmt: skip
    return "\n\n".join(blocks) + "\n"


def method(config: FamilyConfig) -> list[str]:
    """Paragraphs on budget, sequences and measures."""
    form = config.held_out
    fixed = [name for name, member in config.members.items() if member.steps]
    steps = f"Instead of a time, {', '.join(fixed)} had a number of steps. " if fixed else ""
    texts = [
        f"""**Budget.** The time of a step is the processor time of forward pass, loss, backward pass and optimiser,
        on one thread. Rendering, reading of clips and measurements do not count. Each phase of a training is one
        cycle of the learning rate, which follows the share of the phase's time that is used: it rises in the first
        {config.rise:.0%}, then falls to zero. The number of steps therefore depends on the machine, and a
        repetition gives other digits; the setting `steps` of a member fixes it. {steps}The first phase of networks
        with bundle adjustment trains the flow alone, since from scratch the joint loss does not find it; it is part
        of the budget.""",
        f"""**Sequences.** {form.count} rendered sequences of {form.frames} frames of {form.size[1]}x{form.size[0]}
        pixels at {form.fps:g} frames/s, in scenes of families that training never draws
        ({", ".join(form.families)}); camera motion: {", ".join(dict.fromkeys(form.kinds))}. The odometry of each
        member tracks them with the averaged weights; judged is the trajectory after the last frame.""",
        f"""**AUC.** The error of a pair of frames is the larger of its rotation error and the angle between the
        directions of the translations (the rotation alone where the camera moves less than a tenth of its median
        step). A pair with a frame without a pose, or with frames in two segments, has an infinite error. AUC is the
        area under the cumulative recall curve up to the threshold, divided by it, as in the evaluation of SuperGlue
        and LoFTR (`dvo/metrics/relative_pose.py`), over the pairs of all sequences that lie
        {" or ".join(str(gap) for gap in form.gaps)} frames apart.""",
        f"""**Other columns.** ATE: root mean square after alignment by Sim(3), in percent of the path, median over
        the sequences. Rotation: sum of the rotation errors over two frames, over the sum of the true rotations,
        median over the sequences. Frames without a pose count in neither, so the share of frames with one stands
        beside. Speed: frames a second of processor time, one thread, final optimisation included. Memory: peak of
        the process that tracks, and of the one that trains and measures the learning curve (a resumed training: of its
        last process); Python and libraries alone are the row `{NULL}`.""",
        """Tables of all measurements: `runs.csv` (training runs), `curves.csv` (learning curves), `sequences.csv`,
        `pairs.csv` (errors of all pairs, degrees).""",
    ]
    return [paragraph(text) for text in texts]


def paragraph(text: str) -> str:
    """Text in lines of :data:`WIDTH` characters."""
    return textwrap.fill(" ".join(text.split()), WIDTH, break_long_words=False, break_on_hyphens=False)


def _phases(config: FamilyConfig, name: str) -> str:
    member = config.members[name]
    parts = [f"{phase.rate:g} for {phase.share:.0%} of the budget" for phase in member.phases]
    clips = f"{member.batch} clip{'s' * (member.batch > 1)} a step"
    return f"{clips}, learning rate {', then '.join(parts)}"


def ranked(found: Sequence[MemberSummary]) -> list[MemberSummary]:
    """Members by their AUC at one degree, best first; those at two, five and ten decide between equal ones."""
    return sorted(found, key=lambda one: [-one.area[limit, 0].median for limit in LIMITS])


def results(found: Sequence[MemberSummary], null: MemberSummary | None) -> str:
    """Table in Markdown."""
    head = ["member", *(f"AUC {limit:g}°" for limit in LIMITS), "ATE, % of path", "rotation error / motion"]
    head += ["frames with a pose, %", "frames/s", "parameters", "memory, MB", "in training, MB", "steps", "minutes"]
    lines = [row_text(head), row_text(["---", *["--:"] * (len(head) - 1)])]
    for one in [*ranked(found), *([null] if null else [])]:
        cells = [one.name, *(one.area[limit, 0].text(3) for limit in LIMITS)]
        cells += [one.ate_percent.text(2), one.rotation_ratio.text(3), one.posed.times(100).text(0)]
        cells += [one.fps.text(1), one.parameters.text(0), one.memory_mb.text(0), one.training_mb.text(0)]
        lines.append(row_text([*cells, one.steps.text(0), one.seconds.times(1 / 60).text(1)]))
    return "\n".join(lines)


def by_gap(config: FamilyConfig, found: Sequence[MemberSummary], null: MemberSummary | None) -> str:
    """Table in Markdown of the areas by gap."""
    keys = [(limit, gap) for gap in config.held_out.gaps for limit in LIMITS]
    head = ["member", *(f"AUC {limit:g}°, {gap} frame{'s' * (gap > 1)}" for limit, gap in keys)]
    lines = [row_text(head), row_text(["---", *["--:"] * (len(head) - 1)])]
    for one in [*ranked(found), *([null] if null else [])]:
        lines.append(row_text([one.name, *(one.area[key].text(3) for key in keys)]))
    return "\n".join(lines)


def ranking(config: FamilyConfig, found: Sequence[MemberSummary]) -> list[str]:
    """Paragraphs that compare the order of the members with the published one."""
    texts = []
    known = sorted(config.published, key=lambda name: config.published[name])
    here = {one.name: one.area[LIMITS[0], 0].median for one in found if one.name in known}
    if known:
        slide = " < ".join(f"{name} {config.published[name]:.3f}" for name in known)
        texts.append(
            f"""Published order in AUC at 1°: {slide}. These figures come from a slide that states neither data set
            nor definition, so that only the order can be compared."""
        )
    if len(here) > 1:
        ordered = sorted(here, key=lambda name: here[name])
        signs = ["", *(" = " if here[a] == here[b] else " < " for a, b in pairwise(ordered))]
        order = "".join(f"{sign}{name} {here[name]:.3f}" for sign, name in zip(signs, ordered, strict=True))
        pairs = list(combinations([name for name in known if name in here], 2))
        agree = sum(here[low] < here[high] for low, high in pairs)
        texts[-1] += f" Order here: {order}; {agree} of {len(pairs)} pairs of members are in the published order."
    others = [one for one in found if one.name != FAR]
    for far in (one for one in found if one.name == FAR and others):
        rest = ", ".join(f"{one.name} {one.ate_percent.text(2)}" for one in others)
        texts.append(
            f"""The same comparison has {FAR} far behind on ATE. Here, in percent of the path: {FAR}
            {far.ate_percent.text(2)}; {rest}."""
        )
    return [paragraph(text) for text in texts]
