"""Predictions by key: when one is made again and when not."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import cv2

from eval.execution import cache
from eval.execution.cache import data_fingerprint, digest_of, job_key, obtain, reusable, sweep, system_facts
from eval.execution.predict import Job, Prediction, predict_here, write_prediction
from eval.suites.suite import open_sequence


def test_key_changes_with_everything_that_matters(job, tmp_path):
    facts = system_facts("null")
    source, _ = open_sequence(job.sequence, tmp_path, 1)
    data = data_fingerprint(source, job.sequence)
    rendered = {"name": "tiny", "version": 1}

    def digest(job: Job = job, facts=facts, data: str = data, suite=rendered) -> str:
        return digest_of(job_key(job, facts, data, suite))

    others = {
        "system": digest(facts=replace(facts, identity=system_facts("klt-pnp").identity)),
        "settings": digest(facts=replace(facts, identity={**facts.identity, "settings": {"speed": 2}})),
        "version or weights": digest(facts=replace(facts, version="0.1.0+0badcafe")),
        "code": digest(facts=replace(facts, code="1234")),
        "library": digest(facts=replace(facts, libraries={"numpy": "1.0"})),
        "seed": digest(replace(job, seed=1)),
        "stride": digest(replace(job, stride=2)),
        "device": digest(replace(job, device="elsewhere")),
        "data": digest(data="5678"),
        "version of the suite": digest(suite={"name": "tiny", "version": 2}),
    }
    assert len({digest(), *others.values()}) == 1 + len(others), others
    same = (replace(job, folder="x"), replace(job, time_limit=3.0), replace(job, parallel=4), replace(job, threads=7))
    told = replace(job, sequence=replace(job.sequence, about="other words", judged_by="rpe_rot_deg"))
    assert {digest(one) for one in (*same, told)} == {digest()}
    threaded = replace(facts, threads=True)
    assert digest(job, threaded) != digest(replace(job, threads=7), threaded)


def test_predictions_of_an_older_format_are_made_again(job, monkeypatch):
    now = digest_of(job_key(job, system_facts("null"), "1234", {}))
    monkeypatch.setattr(cache, "FORMAT", cache.FORMAT - 1)
    assert digest_of(job_key(job, system_facts("null"), "1234", {})) != now


def test_fingerprint_follows_images_and_calibration(job, tmp_path, image_folder):
    def now() -> str:
        source, _ = open_sequence(job.sequence, tmp_path, 1)
        return data_fingerprint(source, job.sequence)

    before = now()
    os.utime(image_folder / "0003.png", (1, 1))
    assert now() == before  # a copy with other times is the same small sequence
    image = cv2.imread(str(image_folder / "0003.png"))
    cv2.imwrite(str(image_folder / "0003.png"), 255 - image)
    changed = now()
    assert changed != before
    (image_folder.parent / "calib.txt").write_text("51 50 31.5 23.5\n")
    assert now() not in (before, changed)


def test_fingerprint_of_large_sequences_follows_sizes_and_times(job, tmp_path, image_folder, monkeypatch):
    monkeypatch.setattr(cache, "CONTENT_LIMIT", 1000)
    source, _ = open_sequence(job.sequence, tmp_path, 1)
    before = data_fingerprint(source, job.sequence)
    assert data_fingerprint(source, job.sequence) == before
    os.utime(image_folder / "0003.png", (1, 1))
    assert data_fingerprint(source, job.sequence) != before


def test_a_run_is_made_once(job, tmp_path):
    made: list[str] = []

    def run(job: Job) -> Prediction:
        made.append(job.folder)
        return predict_here(job)

    job = replace(job, folder=str(tmp_path / "p" / "seed0-abc"))
    first, old = obtain(job, {"a": 1}, run=run)
    again, older = obtain(job, {"a": 1}, run=run)
    assert (old, older) == (False, True) and len(made) == 1 and again == first
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == ["seed0-abc"]  # nothing half done beside it
    assert json.loads((tmp_path / "p/seed0-abc/key.json").read_text()) == {"a": 1}


def test_failures_stay_unless_they_can_have_passed(job, tmp_path):
    def left(status: str, limit: float = 10.0) -> Prediction | None:
        write_prediction(replace(job, time_limit=limit), Prediction(status))
        return reusable(replace(job, time_limit=20.0))

    assert left("ok") and left("crashed") and left("invalid") and left("timeout", limit=20.0)
    assert left("timeout") is None and left("unavailable") is None and left("no data") is None
    write_prediction(job, Prediction("crashed"))
    assert reusable(job, retry=True) is None
    write_prediction(job, Prediction("ok"))
    assert reusable(job, retry=True)


def test_halves_are_swept(tmp_path):
    (tmp_path / "null/.part-seed0-abc-1-2").mkdir(parents=True)
    (tmp_path / "null/seed0-abc").mkdir()
    sweep(tmp_path)
    assert [path.name for path in (tmp_path / "null").iterdir()] == ["seed0-abc"]
