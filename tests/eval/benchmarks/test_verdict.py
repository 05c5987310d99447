"""Manufactured failures, their verdicts in a table, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.config import preset
from eval.benchmarks.verdict import failures
from eval.benchmarks.verdict.__main__ import interval, main, table
from eval.benchmarks.verdict.trials import CHANGES, KINDS, Outcome, Trial
from tests.support.tiny_tracker import frames


@pytest.mark.parametrize("kind", CHANGES)
@pytest.mark.parametrize("number", range(4))
def test_a_change_keeps_times_and_sizes_and_is_seeded(kind, number):
    given = frames(4, size=(96, 72))
    found, again = (list(CHANGES[kind](np.random.default_rng(1), given, number)) for _ in range(2))
    for one, other, frame in zip(found, again, given, strict=True):
        assert one.timestamp == frame.timestamp and one.image.shape[:2] == (one.camera.height, one.camera.width)
        assert one.image.dtype == np.uint8 and np.array_equal(one.image, other.image)
        assert kind == "crop" or one.image.shape == frame.image.shape
    if kind == "crop":  # the camera states where the crop lies when it does not float
        margin = (given[0].camera.width - found[0].camera.width) // 2
        assert margin > 0 and found[0].camera.cx == given[0].camera.cx - margin
        given = [replace(frame, image=frame.image[margin:-margin, margin:-margin]) for frame in given]
    changed = np.mean([(one.image != frame.image).mean() for one, frame in zip(found[1:], given[1:], strict=True)])
    assert changed == 0 if kind == "focal" else changed > 0.05
    assert (found[0].camera.fx != given[0].camera.fx) == (kind in ("focal", "lens"))


def test_what_is_fixed_stays_and_what_moves_moves():
    given = frames(6)
    one, *_, last = failures.with_overlay(np.random.default_rng(0), given, 0)
    assert np.array_equal(one.image[-8:], last.image[-8:])
    one, other, *_ = failures.with_waves(np.random.default_rng(0), given, 0)
    assert not np.array_equal(one.image[-8:], other.image[-8:])
    one, *_, last = failures.before_still_camera(np.random.default_rng(0), given, 1)
    assert np.median(np.abs(one.image.astype(int) - given[0].image)) < 5


def test_a_spoiled_network_is_another_one():
    networks = [PatchVO(preset("tiny")) for _ in range(2)]
    networks[1].load_state_dict(networks[0].state_dict())
    failures.spoil(networks[1], 0)
    pairs = list(zip(*(network.parameters() for network in networks), strict=True))
    assert any((a != b).any() for a, b in pairs) and all((a == b).all() for a, b in pairs if a.dim() < 2)


def test_scenes_are_those_of_their_kind_and_number():
    assert len({str(Trial(kind, number).options) for kind in KINDS for number in range(20)}) > 40
    assert Trial("right", 18).options["kind"] == "rotation"


def outcome(kind, number, wrong, verdict, poses=48):
    return Outcome(kind, number, wrong, 1.0, None, poses, {"verdict": verdict, "reason": ""})


def test_the_table_counts_right_and_wrong_runs():
    lines = table([
        outcome("right", 0, False, "good"), outcome("right", 1, False, "doubtful"),
        outcome("waves", 0, True, "doubtful"), outcome("waves", 1, True, "good"),
        outcome("waves", 2, False, "failed", 0),
    ]).splitlines()  # fmt: skip
    cells = {line.split("|")[1].strip(): [cell.strip() for cell in line.split("|")[2:-1]] for line in lines[2:]}
    assert cells["waves"][:3] == ["3", "1", "2"] and cells["waves"][3].startswith("1 of 2, 50 %")
    assert cells["right"][4:] == ["2", "1 of 2, 50 % (9 to 91)"] and cells["all"][:2] == ["5", "1"]


def test_intervals():
    assert interval(0, 0) == "-" and interval(10, 10) == "10 of 10, 100 % (72 to 100)"
    assert interval(3, 100) == "3 of 100, 3 % (1 to 8)"


def test_what_is_not_understood_is_refused(tmp_path, capsys):
    (tmp_path / "outcomes.jsonl").write_text('{"kind": "right"}\n')
    for more in (["--jobs", "0"], ["--right", "0"], []):
        with pytest.raises(SystemExit):
            main(["--out", str(tmp_path), *more])
    assert "not an outcome" in capsys.readouterr().err


def test_the_command_goes_on_from_what_is_kept(tmp_path, capsys):
    kept = [outcome(kind, 0, kind != "right", "good" if kind == "right" else "doubtful") for kind in KINDS]
    (tmp_path / "outcomes.jsonl").write_text("".join(json.dumps(vars(one)) + "\n" for one in kept))
    main(["--right", "1", "--wrong", "1", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert (
        f"{len(KINDS) - 1} of {len(KINDS) - 1}, 100 %" in printed
        and "0 of 1, 0 %" in printed
        and "the other scenes" in printed
    )
