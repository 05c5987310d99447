"""One run in a process of its own: ``python -m eval.execution.worker JOB.json``, started by
:func:`eval.execution.predict.predict`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2

from eval.execution.predict import Job, predict_here
from eval.suites.selection import sequence_from


def main(path: str) -> None:
    """Do the job in the file; the prediction lies in the job's folder afterwards.

    Args:
        path: JSON form of a :class:`eval.execution.predict.Job`.
    """
    entry = json.loads(Path(path).read_text(encoding="utf-8"))
    job = Job(**{**entry, "sequence": sequence_from(entry["sequence"])})
    cv2.setNumThreads(job.threads)
    predict_here(job)


if __name__ == "__main__":
    main(sys.argv[1])
