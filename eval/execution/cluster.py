"""Predictions over a Ray cluster.

Each node needs this checkout's environment and the data under the same paths. Results come back through Ray, so the
folder of results need not be shared.
"""

from __future__ import annotations

import importlib
import io
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from eval.execution.cache import commit, part_folder
from eval.execution.predict import Job, Prediction, predict, read_prediction
from eval.suites.suite import ROOT


def run_on_ray(jobs: list[tuple[Job, dict[str, Any]]], address: str) -> Iterator[tuple[int, Prediction]]:
    """Run jobs with their keys; yields the number of each as it is done and stored.

    Args:
        address: of the cluster (``auto``, ``ray://host:port``), or ``local`` for one on this machine.

    Raises:
        DvoError: Ray is not installed, or there is no cluster.
    """
    try:
        ray = importlib.import_module("ray")
    except ImportError:
        raise DvoError("Ray is not installed", field="--ray", remedy="pip install -e '.[ray]'") from None
    # A cluster of one's own machine inherits this environment; a remote one has its own.
    options = {"runtime_env": {"env_vars": {"PYTHONPATH": str(ROOT)}}} if address == "local" else {}
    try:
        ray.init(address=address, log_to_driver=False, **options)
    except (ConnectionError, ValueError, RuntimeError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DvoError(
            f"no Ray cluster at '{address}' ({said})", field="--ray", remedy="start one: ray start"
        ) from error
    try:
        threads = max(job.threads for job, _ in jobs)
        remote = ray.remote(num_cpus=threads, max_retries=0)(run_packed)
        waiting = {remote.remote(job): number for number, (job, _) in enumerate(jobs)}
        while waiting:
            done, _ = ray.wait(list(waiting), num_returns=1)
            number = waiting.pop(done[0])
            job, key = jobs[number]
            yield number, unpack(ray.get(done[0]), job, key)
    finally:
        ray.shutdown()


def run_packed(job: Job) -> bytes:
    """On the node: run a job in a folder of its own and pack what it leaves."""
    with tempfile.TemporaryDirectory(prefix="dvo-eval-") as folder:
        predict(replace(job, folder=str(Path(folder) / "run")))
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(path for path in (Path(folder) / "run").rglob("*") if path.is_file()):
                archive.write(file, file.relative_to(Path(folder) / "run"))
        return buffer.getvalue()


def unpack(packed: bytes, job: Job, key: dict[str, Any]) -> Prediction:
    """On the driver: put a packed run into its place."""
    part = part_folder(job)
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        archive.extractall(part)
    commit(part, Path(job.folder), key)
    return read_prediction(job.folder)
