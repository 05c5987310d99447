"""A terminal in a test: commands as the documentation writes them, run as processes in one folder."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Said:
    """Output of a command.

    Attributes:
        out, err: standard output and error.
    """

    out: str
    err: str


@dataclass(frozen=True)
class Terminal:
    """Runs commands in a folder, with one thread.

    Attributes:
        folder: working directory; has ``configs``, as a checkout.
    """

    folder: Path

    @classmethod
    def at(cls, folder: Path) -> Terminal:
        """Terminal in a new folder, in which relative paths of the configurations lead to those of the checkout."""
        (folder / "configs").symlink_to(ROOT / "configs")
        return cls(folder)

    def type(self, line: str, stdin: bytes | None = None, code: int = 0, **environment: str) -> Said:
        """Run ``dvo ...`` or ``python -m ...``.

        Args:
            line: as it is typed, quoted as for a shell.
            stdin: input of the process, as through a pipe.
            code: exit code to be expected.
            environment: further variables.
        """
        program, *words = shlex.split(line)
        command = {"dvo": [sys.executable, "-m", "dvo"], "python": [sys.executable]}[program]
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        done = subprocess.run(
            [*command, *words], cwd=self.folder, input=stdin, stdin=subprocess.DEVNULL if stdin is None else None,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **environment}, capture_output=True,
            timeout=1800,
        )  # fmt: skip
        said = Said(done.stdout.decode(), done.stderr.decode())
        assert done.returncode == code, f"{line}\n{said.out}\n{said.err}"
        assert "Traceback" not in said.err, said.err
        return said
