"""Training programs, run from a checkout:

- ``python -m train fit --config configs/train/small.yaml`` trains the network of the task that the configuration names
  (LightningCLI). ``--name RUN`` names the folder of everything that it writes, ``--from FILE`` starts a new run from a
  training state or from weights, ``--steps N`` takes N steps from there. Ctrl-C stops after the running step and saves;
  ``--resume`` goes on.
- ``export CHECKPOINT FILE`` writes the weights; ``validate CHECKPOINT`` tracks real sequences with them.
- ``state CHECKPOINT FILE`` copies a training state without the paths of the machine that it comes from.
- ``snr CHECKPOINT`` measures the signal-to-noise ratio of gradients, for ``patch_vo`` of the plain and the weighted
  (V2V) flow loss.
- ``study --config configs/train/study.yaml`` compares losses on the same clips, for ``patch_vo`` DPVO's with V2V's.
- ``family`` trains every member of the learned family for the same processor time on the same clips, and compares them
  on held-out sequences; ``--report`` prints the comparison again.
- ``places`` fits the descriptor of places, by which keyframes are found again, to a network.
- ``profile`` prints where the seconds of a training step go.
"""

from __future__ import annotations

import importlib
import sys

COMMANDS = {
    "export": "train.engine.export:export",
    "state": "train.engine.export:export_state",
    "validate": "train.validation.validate:main",
    "snr": "train.studies.snr:main",
    "study": "train.studies.study:main",
    "family": "train.studies.family.study:main",
    "places": "train.places:main",
    "profile": "train.studies.breakdown:main",
}


def main() -> None:
    """Entry point; bad input ends with code 2 and one line."""
    from dvo.core.errors import DvoError
    from dvo.core.limits import limit_error
    from dvo.core.text import print_line

    try:
        run()
    except DvoError as error:
        print_line(f"error: {error}", error=True)
        sys.exit(2)
    except Exception as error:
        limited = limit_error(error)
        if limited is None:
            raise
        print_line(f"error: {limited}", error=True)
        sys.exit(2)


def run() -> None:
    """Run the command that the command line names; ``fit`` is for LightningCLI.

    Raises:
        DvoError: no such command.
    """
    from dvo.core.errors import DvoError

    command, rest = (sys.argv[1:2] or [""])[0], sys.argv[2:]
    if command in COMMANDS:
        module, _, function = COMMANDS[command].partition(":")
        getattr(importlib.import_module(module), function)(rest)
        return
    if command in ("-h", "--help"):
        print(__doc__)
        return
    if command != "fit":
        remedy = f"give one of fit, {', '.join(COMMANDS)}"
        raise DvoError(f"no command '{command}'" if command else "a command is missing", remedy=remedy)
    from dvo.core.allocator import reuse_freed_memory
    from train.engine.cli import train

    reuse_freed_memory()
    train()


if __name__ == "__main__":
    main()
