"""Process of one video of ``dvo batch``: ``python -m dvo.batch_worker PARENT run ...`` is ``dvo run ...``.

It stops as with SIGTERM when the process of the number PARENT, which has started it, is gone.
"""

from __future__ import annotations

import sys

import dvo  # noqa: F401  decides how threads wait, before torch is imported

# isort: split
import cv2

from dvo.cli import main
from dvo.core.processes import stop_with_parent
from dvo.core.threads import settle_threads

if __name__ == "__main__":
    stop_with_parent(int(sys.argv[1]))
    cv2.setNumThreads(settle_threads().count)  # which knows no variable of the environment
    sys.exit(main(sys.argv[2:]))
