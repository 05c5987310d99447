"""Page and figure from tables."""

import numpy as np
import pytest

from dvo.core.errors import DvoError
from train.studies.family.config import Member, Phase
from train.studies.family.records import Records
from train.studies.family.report import write_report
from train.studies.family.summary import Spread, learning_curve, summarise

MEMBERS = {
    name: Member("deepvo", (Phase(1.0, 1e-3),), about=f"about {name}") for name in ("a", "b", "tartanvo", "absent")
}


def fill(config, errors):
    """Tables in which each pair of a member has the same error, in degrees, by seed."""
    records = Records(config)
    names = list(config.held_out.sequences())
    for member, by_seed in errors.items():
        for seed, error in enumerate(by_seed):
            run = {"member": member, "seed": seed, "digest": config.digest(member)}
            if member != "null":
                records.runs.append(**run, parameters=1234, steps=10, clips=10, skipped=0, seconds=60.0, memory_mb=50.0)
                for point in (0, 1, 2):
                    values = {"step": 5 * point, "auc_10": 0.1 * point + seed, "rotation_ratio": 1.0 - 0.1 * point}
                    records.curves.append(
                        **run, **values, point=point, sequence=names[0], seconds=1800.0 * point, posed=8
                    )
            for k, name in enumerate(names):
                for gap in config.held_out.gaps:
                    pairs = " ".join([f"{error}"] * (8 - gap))
                    records.pairs.append(**run, sequence=name, gap=gap, errors_deg=pairs)
                records.sequences.append(
                    **run, sequence=name, frames=8, posed=6, segments=1, ate_percent=2.0 * error + k,
                    rotation_ratio=0.5, fps=20.0 + k, memory_mb=100.0 + k,
                )  # fmt: skip
    return records


@pytest.fixture
def config(family):
    return family(members=MEMBERS, seeds=(0, 1), published={"c": 0.9, "a": 0.2, "b": 0.1}, minutes=3.0)


def test_the_page_holds_what_the_tables_hold(config):
    records = fill(config, {"a": (0.5, 0.0), "b": (20.0, 20.0), "tartanvo": (5.0, 5.0), "null": (30.0,)})
    page, picture = write_report(records)
    text = page.read_text(encoding="utf-8")
    for place in ("| member | AUC 1° |", "| member | AUC 1°, 1 frame |"):
        table = [line for line in text[text.index(place) :].splitlines() if line.startswith("|")][:5]
        assert len({line.count("|") for line in table}) == 1
    # 26 pairs of 0.5 degrees: a triangle up to the first one, then all of them; with the other seed's area of 1
    area = 0.5 * 0.5 / 26 + 0.5
    assert f"| a | {(area + 1) / 2:.3f} [{area:.3f}-1.000]" in text
    assert "| b | 0.000 | 0.000 | 0.000 | 0.000 | 40.50 | 0.500 | 75 | 20.5 | 1,234 | 101 | 50 | 10 | 1.0 |" in text
    order = [line.split(" | ")[0] for line in text.splitlines() if line.startswith(("| a", "| b", "| tart", "| null"))]
    assert order == ["| a", "| tartanvo", "| b", "| null"] * 2
    flat = " ".join(text.split())
    assert "Published order in AUC at 1°: b 0.100 < a 0.200 < c 0.900." in flat
    assert "Order here: b 0.000 < a 0.755; 1 of 1 pairs of members are in the published order." in flat
    assert "percent of the path: tartanvo 10.50; a 1.00 [0.50-1.50], b 40.50." in flat
    assert "Not measured yet: absent." in flat and "about a" in flat and "each for 3 minutes" in flat
    assert max(len(line) for line in text.splitlines() if not line.startswith("|")) <= 128
    assert picture.read_bytes().startswith(b"<?xml")


@pytest.mark.long
def test_the_same_tables_give_the_same_bytes(config):
    records = fill(config, {"a": (0.5, 1.0)})
    before = [file.read_bytes() for file in write_report(records)]
    assert [file.read_bytes() for file in write_report(records)] == before


def test_runs_that_are_not_complete_are_left_out(config):
    records = Records(config)
    with pytest.raises(DvoError, match="no complete run"):
        write_report(records)
    fill(config, {"a": (0.5,)})
    name = next(iter(config.held_out.sequences()))
    records.sequences.append(
        member="a", seed=1, digest=config.digest("a"), sequence=name, frames=8, posed=8, segments=1, ate_percent=1.0,
        rotation_ratio=1.0, fps=1.0, memory_mb=1.0,
    )  # fmt: skip
    found = summarise(records, "a")
    assert found.seeds == (0,) and summarise(records, "b") is None


def test_medians_treat_what_is_missing_as_worse_than_anything():
    assert Spread.of([1.0, np.nan, 3.0]) == Spread(3.0, 1.0, np.inf)
    assert Spread.of([np.nan]).text(1) == Spread.of([]).text(1) == "–"
    assert Spread.of([1.0, 2.0]).text(1) == "1.5 [1.0-2.0]" and Spread.of([1234.0]).text(0) == "1,234"
    assert Spread.of([2.0]).times(0.5) == Spread(1.0, 1.0, 1.0)


def test_learning_curves_have_the_points_of_all_seeds(config):
    records = fill(config, {"a": (0.5, 1.0)})
    records.curves.append(
        member="a", seed=0, point=3, sequence="x", digest=config.digest("a"), step=1, seconds=1.0, auc_10=1.0,
        rotation_ratio=1.0, posed=1,
    )  # fmt: skip
    curve = learning_curve(records, "a", "auc_10")
    assert curve.hours.tolist() == [0, 0.5, 1.0] and curve.values.tolist() == [[0, 0.1, 0.2], [1, 1.1, 1.2]]
    assert learning_curve(records, "b", "auc_10") is None
