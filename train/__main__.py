"""Training programs, run from a checkout:

- ``python -m train fit --config configs/train/small.yaml`` trains (LightningCLI). Ctrl-C stops after the running step
  and saves; the same command goes on.
- ``export CHECKPOINT FILE`` ships the weights; ``validate CHECKPOINT`` tracks real sequences with them.
- ``snr CHECKPOINT`` measures the signal-to-noise ratio of the flow loss's gradient, plain and weighted (V2V).
- ``study --config configs/train/study.yaml`` compares DPVO's loss with V2V's.
- ``profile`` prints where the seconds of a training step go.
"""

from __future__ import annotations

import importlib
import sys

COMMANDS = {
    "export": "train.engine.export",
    "validate": "train.validation.validate",
    "snr": "train.studies.snr",
    "study": "train.studies.study",
    "profile": "train.studies.breakdown",
}


def main() -> None:
    """Entry point; bad input ends with code 2 and one line."""
    from dvo.errors import DvoError

    try:
        run()
    except DvoError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def run() -> None:
    """What may be typed after ``python -m train``."""
    command, rest = (sys.argv[1:2] or [""])[0], sys.argv[2:]
    if command in COMMANDS:
        importlib.import_module(COMMANDS[command]).main(rest)
        return
    from lightning.pytorch.cli import LightningCLI

    from dvo.allocator import reuse_freed_memory
    from train.data.clips import Renderings
    from train.tasks.patch_vo.module import PatchVOTraining

    reuse_freed_memory()
    LightningCLI(PatchVOTraining, Renderings, seed_everything_default=0, save_config_kwargs={"overwrite": True})


if __name__ == "__main__":
    main()
