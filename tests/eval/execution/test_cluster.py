"""Runs on a Ray cluster, with a stand-in for Ray."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from eval.execution.cache import reusable
from eval.execution.predict import Job, Prediction, predict_here
from eval.execution.runner import predict_all


def test_ray_missing_and_packed_runs(job, tmp_path, image_folder, monkeypatch, plan):
    from eval.execution import cluster

    job = replace(job, folder=str(tmp_path / "p/seed0-abc"))
    monkeypatch.setattr(cluster, "predict", predict_into_new_folder)
    done = cluster.unpack(cluster.run_packed(job), job, {"k": 1})
    assert done.status == "ok" and done.tracked == 20 and reusable(job) == done
    assert np.isfinite(np.loadtxt(tmp_path / "p/seed0-abc/trajectory.txt")).all()

    asked: list[str] = []
    monkeypatch.setattr(cluster.cluster.importlib, "import_module", lambda name: PretendedRay(asked))
    said: list[str] = []
    predict_all(replace(plan, systems=("null",), ray="auto"), said.append)
    assert asked == ["init auto", "cpus 1", "run 0", "run 1", "shutdown"]
    assert [text.split(": ")[1] for text in said] == ["20/20 frames"] * 2

    def absent(name: str):
        raise ImportError(name)

    monkeypatch.setattr(cluster.cluster.importlib, "import_module", absent)
    with pytest.raises(DvoError, match="Ray is not installed"):
        predict_all(replace(plan, systems=("null",), seeds=(7,), ray="auto"), lambda text: None)


def predict_into_new_folder(job: Job) -> Prediction:
    Path(job.folder).mkdir(parents=True)
    return predict_here(job)


class PretendedRay:
    """The part of Ray that is used, in this process; the last run asked for is done first."""

    def __init__(self, asked: list[str]) -> None:
        self.asked = asked

    def init(self, address: str, **options) -> None:
        self.asked.append(f"init {address}")

    def remote(self, **options):
        self.asked.append(f"cpus {options['num_cpus']}")

        def wrap(function):
            def start(job: Job) -> tuple:
                self.asked.append(f"run {job.seed}")
                return (function, job)

            return type("Remote", (), {"remote": staticmethod(start)})

        return wrap

    def nodes(self) -> list[dict]:
        return [{"Alive": True, "Resources": {"CPU": 2.0}}]

    def wait(self, waiting: list, num_returns: int, timeout: float) -> tuple[list, list]:
        return waiting[-num_returns:], waiting[:-num_returns]

    def get(self, reference: tuple) -> bytes:
        return reference[0](reference[1])

    def shutdown(self) -> None:
        self.asked.append("shutdown")
