"""``python -m train fit --config configs/train/small.yaml``: training by LightningCLI; ``export`` ships the weights.

Ctrl-C stops after the running step and saves; the same command with ``--ckpt_path last`` goes on. See train/LOG.md.
"""

from __future__ import annotations

import sys

from lightning.pytorch.cli import LightningCLI

from dvo.allocator import reuse_freed_memory
from train.data import Renderings
from train.module import PatchVOTraining


def main() -> None:
    """Entry point."""
    if sys.argv[1:2] == ["export"]:
        from train.export import main as export

        export(sys.argv[2:])
        return
    reuse_freed_memory()
    LightningCLI(
        PatchVOTraining,
        Renderings,
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
    )


if __name__ == "__main__":
    main()
