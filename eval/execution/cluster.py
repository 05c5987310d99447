"""Predictions over a Ray cluster; see :mod:`dvo.core.cluster`. Each node needs the data under the same paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core import cluster
from dvo.data.files.output import scratch_folder
from eval.execution.cache import commit, part_folder
from eval.execution.predict import Job, Prediction, predict, read_prediction
from eval.suites.suite import ROOT


def run_on_ray(jobs: list[tuple[Job, dict[str, Any]]], address: str) -> Iterator[tuple[int, Prediction]]:
    """Run jobs with their keys; yields the number of each as it is done and stored.

    Args:
        address: of the cluster (``auto``, ``ray://host:port``), or ``local`` for one on this machine.

    Raises:
        DvoError: Ray is not installed, there is no cluster, or no node with enough CPUs.
    """
    with cluster.connected(address, ROOT) as ray:
        threads = max(job.threads for job, _ in jobs)
        for number, result in cluster.run_on(ray, run_packed, [job for job, _ in jobs], threads=threads):
            yield number, unpack(result(), *jobs[number])


def run_packed(job: Job) -> bytes:
    """On the node: run a job in a folder of its own and pack what it leaves."""
    with scratch_folder("dvo-eval") as folder:
        place = folder / "run"
        predict(replace(job, folder=str(place)))
        return cluster.packed(place)


def unpack(packed: bytes, job: Job, key: dict[str, Any]) -> Prediction:
    """On the driver: put a packed run into its place."""
    part = part_folder(job)
    cluster.unpack(packed, part)
    commit(part, Path(job.folder), key)
    return read_prediction(job.folder)
