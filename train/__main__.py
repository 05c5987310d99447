"""``python -m train fit --config configs/train/small.yaml``: training by LightningCLI; ``export`` ships the weights,
``validate`` tracks real sequences with them.

Ctrl-C stops after the running step and saves; the same command with ``--ckpt_path last`` goes on. See train/LOG.md.
"""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point."""
    command, rest = (sys.argv[1:2] or [""])[0], sys.argv[2:]
    if command == "export":
        from train.export import main as export

        export(rest)
    elif command == "validate":
        from train.validate import main as validate

        validate(rest)
    else:
        from lightning.pytorch.cli import LightningCLI

        from dvo.allocator import reuse_freed_memory
        from train.data import Renderings
        from train.module import PatchVOTraining

        reuse_freed_memory()
        LightningCLI(PatchVOTraining, Renderings, seed_everything_default=0, save_config_kwargs={"overwrite": True})


if __name__ == "__main__":
    main()
