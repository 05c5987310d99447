"""The rendered suites and their cache."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.files.output import scratch_folder
from dvo.synth import HELD_OUT, LONG_KINDS, make_sequence
from dvo.synth.export import write_calibration
from dvo.synth.surroundings import SURROUNDINGS
from eval import commands
from eval.__main__ import main
from eval.suites.rendered import RECORD, place_of, rendered_folder
from eval.suites.suite import Sequence, open_sequence, read_suites

AXES = {
    "plain", "scale", "textureless", "fast", "blur", "rotation", "lighting", "dynamic", "rolling_shutter", "blackout",
    "loop", "low_light",
}  # fmt: skip
OPTIONS: dict[str, Any] = {
    "seed": 3_000_000_000, "family": "room", "frames": 4, "fps": 15.0, "width": 80, "height": 60, "version": 1,
}  # fmt: skip
NOWHERE = Path("there/are/no/recordings")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DVO_CACHE", str(tmp_path))
    return tmp_path / "suites"


def test_twelve_axes_two_tiers_two_splits() -> None:
    seeds: dict[str, set[int]] = {}
    names = []
    for split in ("validation", "test"):
        for tier, count in (("mini", 2), ("large", 4)):
            suites = read_suites(f"axes/{split}/{tier}")
            assert {suite.name.split("/")[0] for suite in suites} == AXES and len(suites) == 12
            for suite in suites:
                assert len(suite.sequences) == count and suite.label.startswith(f"rendered, {split}")
                for sequence in suite.sequences:
                    options = dict(sequence.rendered or ())
                    seconds = options["frames"] / options["fps"]
                    assert options["apart"] is True and options["seed"] >= 2**31
                    assert options["family"] in HELD_OUT and options["kind"] in LONG_KINDS
                    assert seconds == 8 and options["fps"] == 15 if tier == "mini" else 10 <= seconds <= 20
                    assert tier == "mini" or options["fps"] >= 20
                    seeds.setdefault(split, set()).add(options["seed"])
                    names.append(sequence.name)
            sizes = {dict(s.rendered or ())["width"] for suite in suites for s in suite.sequences}
            assert sizes == ({320} if tier == "mini" else {320, 640})
    assert len(seeds["validation"]) == len(seeds["test"]) == 72, "a seed is used twice"
    assert not seeds["validation"] & seeds["test"]
    assert len(set(names)) == len(names)


def test_places_seen_again_are_suites_of_their_own() -> None:
    others = {dict(q.rendered or ())["seed"] for split in ("validation", "test") for tier in ("mini", "large")
              for suite in read_suites(f"axes/{split}/{tier}") for q in suite.sequences}  # fmt: skip
    seeds = []
    for split in ("validation", "test"):
        for tier, count in (("mini", 3), ("large", 6)):
            suites = read_suites(f"memory/{split}/{tier}")
            assert [suite.name.split("/")[0] for suite in suites] == ["revisit", "kidnap"]
            for suite in suites:
                options = [dict(sequence.rendered or ()) for sequence in suite.sequences]
                assert len(options) == count and {one["family"] for one in options} == set(HELD_OUT)
                assert suite.label.startswith(f"rendered, {split}") and all(one["apart"] for one in options)
                seeds += [one["seed"] for one in options]
                longest = min(one["frames"] / one["fps"] for one in options)
                assert longest >= 120 if suite.name.startswith("revisit") else longest == 40
                assert all(one.get("blackout") == (None if one["kind"] == "revisit" else 2.0) for one in options)
    assert len(set(seeds)) == len(seeds) == 36 and not others & set(seeds)
    assert read_suites("kidnap/test") == [read_suites("memory/test")[1]]
    assert {q.judged_by for q in read_suites("kidnap")[0].sequences} == {"recovery_s"}


def test_suites_of_ordinary_footage_stand_apart() -> None:
    others = {dict(q.rendered or ())["seed"] for name in ("axes", "memory") for split in ("validation", "test")
              for tier in ("mini", "large") for suite in read_suites(f"{name}/{split}/{tier}")
              for q in suite.sequences}  # fmt: skip
    found = [dict(q.rendered or ()) for split in ("validation", "test") for tier in ("mini", "large")
             for suite in read_suites(f"world/{split}/{tier}") for q in suite.sequences]  # fmt: skip
    names = [suite.name for suite in read_suites("world")]
    assert names == ["water", "sky", "foliage", "bonnet", "far", "crowd", "rain", "road"]
    seeds = {one["seed"] for one in found}
    assert len(seeds) == len(found) == 2 * 8 * 6 and not seeds & others
    assert all(one["apart"] and one["family"] in HELD_OUT for one in found)
    assert {name for one in found for name in one.get("surroundings", "").split("+")} <= {"", *SURROUNDINGS}


def test_names_on_the_command_line() -> None:
    assert [suite.name for suite in read_suites("fast")] == ["fast"]
    assert [suite.name for suite in read_suites("fast/test/large")] == ["fast/test/large"]
    assert read_suites("fast") == read_suites("fast/validation/mini")
    assert [suite.name for suite in read_suites("validation")] == ["validation"]
    assert len(read_suites("axes")) == 12
    assert {s.name for s in read_suites("axes") for q in s.sequences if q.judged_by == "rpe_rot_deg"} == {
        "rotation", "blackout",
    }  # fmt: skip
    with pytest.raises(DvoError, match="huge"):
        read_suites("fast/huge")
    with pytest.raises(DvoError, match="low_light"):
        read_suites("no such suite")


def test_each_axis_differs_from_plain_by_its_effect() -> None:
    plain = dict(read_suites("plain")[0].sequences[0].rendered or ())
    drawn = {"seed", "family"}
    for suite in read_suites("axes")[1:]:
        options = dict(suite.sequences[0].rendered or ())
        assert {k: v for k, v in options.items() if k not in drawn} != {
            k: v for k, v in plain.items() if k not in drawn
        }, suite.name
    blackout = dict(read_suites("blackout")[0].sequences[0].rendered or ())
    assert blackout["blackout"] == 2.0


def test_readers_give_back_what_was_rendered(cache: Path) -> None:
    sequence = Sequence("one", rendered=tuple(OPTIONS.items()))
    source, truth = open_sequence(sequence, NOWHERE, 1)
    original = make_sequence(**{key: value for key, value in OPTIONS.items() if key != "version"})
    frames, expected = list(source), list(original)
    assert len(frames) == len(expected) == 4
    for read, drawn in zip(frames, expected, strict=True):
        assert np.array_equal(read.image, drawn.image) and read.timestamp == pytest.approx(drawn.timestamp, abs=1e-8)
        assert np.allclose(read.camera.intrinsics, drawn.camera.intrinsics, atol=1e-8)
    assert np.allclose(truth.poses_wc, original.groundtruth.poses_wc, atol=1e-7)
    assert np.allclose(truth.timestamps, original.groundtruth.timestamps, atol=1e-8)
    # As the worker of a run gets it: through JSON.
    again = Sequence(**json.loads(json.dumps({"name": "one", "rendered": sequence.rendered})))
    assert open_sequence(again, NOWHERE, 1)[0].path == source.path


def test_the_right_camera_of_a_stereo_pair_is_written_and_read(cache: Path) -> None:
    options = {**OPTIONS, "frames": 2, "baseline": 0.12}
    source, _ = open_sequence(Sequence("pair", rendered=tuple(options.items())), NOWHERE, 1)
    right = make_sequence(**{k: v for k, v in OPTIONS.items() if k != "version"} | {"frames": 2}).stereo(0.12)
    for k, frame in enumerate(source):
        assert frame.right is not None and frame.right.baseline == pytest.approx(0.12)
        assert np.array_equal(frame.right.image, right.frame(k).image)
        assert not np.array_equal(frame.right.image, frame.image)
    assert len(read_suites("stereo")[0].sequences) == 3


def test_every_frame_of_a_rolling_shutter_has_its_readout(cache: Path) -> None:
    options = {**OPTIONS, "rolling_shutter": 0.5}
    source, _ = open_sequence(Sequence("one", rendered=tuple(options.items())), NOWHERE, 1)
    assert [frame.camera.readout for frame in source] == pytest.approx([0.5 / 15] * 4, abs=1e-8)
    still, _ = open_sequence(Sequence("one", rendered=tuple(OPTIONS.items())), NOWHERE, 1)
    assert {frame.camera.readout for frame in still} == {0.0}


def test_renderings_of_before_the_readout_are_not_used() -> None:
    for suite in read_suites("axes"):
        for sequence in suite.sequences:
            assert dict(sequence.rendered or ())["version"] >= 4


def test_cache_is_used_and_keyed_by_everything(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = rendered_folder("one", OPTIONS)
    stamp = (folder / RECORD).stat().st_mtime_ns
    monkeypatch.setattr("dvo.synth.sequence.make_sequence", lambda **_: pytest.fail("rendered again"))
    assert rendered_folder("one", dict(reversed(OPTIONS.items()))) == folder
    assert (folder / RECORD).stat().st_mtime_ns == stamp
    others = [place_of("one", {**OPTIONS, key: 2}) for key in ("version", "seed", "frames")]
    assert len({folder, place_of("two", OPTIONS), *others}) == 5


def test_interrupted_rendering_leaves_nothing_that_counts(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    write, calls = cv2.imwrite, []

    def stop(*given: Any) -> bool:
        calls.append(given)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return bool(write(*given))

    monkeypatch.setattr(cv2, "imwrite", stop)
    with pytest.raises(KeyboardInterrupt):
        rendered_folder("one", OPTIONS)
    assert list(cache.iterdir()) == []
    monkeypatch.setattr(cv2, "imwrite", write)
    # A killed process cannot clean up: its folder does no harm and goes with the next one.
    with scratch_folder(place_of("one", OPTIONS).name, cache) as part:
        left = part.with_name(part.name.replace(f"-{os.getpid()}-", f"-{2**31 - 1}-"))  # a number that no process has
    (left / "rgb").mkdir(parents=True)
    folder = rendered_folder("one", OPTIONS)
    assert len(list((folder / "rgb").iterdir())) == 4 and [one.name for one in cache.iterdir()] == [folder.name]


def test_two_at_once_agree(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process finishes the same sequence first: its folder stands, ours goes."""

    def slow(*given: Any) -> None:
        monkeypatch.setattr("dvo.synth.export.write_calibration", write_calibration)
        (rendered_folder("one", OPTIONS) / "first").touch()
        write_calibration(*given)

    monkeypatch.setattr("dvo.synth.export.write_calibration", slow)
    folder = rendered_folder("one", OPTIONS)
    assert (folder / "first").is_file() and [path.name for path in cache.iterdir()] == [folder.name]


def test_prepare_renders_and_says_so(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    suites = read_suites("plain")
    short = tuple(Sequence(q.name, rendered=tuple({**dict(q.rendered or ()), **OPTIONS}.items()))
                  for q in suites[0].sequences[:1])  # fmt: skip
    from dataclasses import replace

    monkeypatch.setattr(commands, "read_suites", lambda _: [replace(suites[0], sequences=short)])
    assert main(["prepare", "plain", "--sheet", str(tmp_path / "sheet.png")]) == 0
    assert "1 rendered now" in capsys.readouterr().out and (tmp_path / "sheet.png").is_file()
    assert main(["prepare", "plain", "--sheet", str(tmp_path / "sheet.nonsense")]) == 2
    captured = capsys.readouterr()
    assert "in the cache" in captured.out and "ends in .png" in captured.err
    monkeypatch.undo()
    assert main(["prepare", "nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err


def test_bad_options_name_the_sequence(cache: Path) -> None:
    with pytest.raises(DvoError, match="one"):
        rendered_folder("one", {**OPTIONS, "colour": "red"})
    assert list(cache.iterdir()) == []
