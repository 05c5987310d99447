"""All that needs an accelerator, in one command and within a given time: `python -m eval.benchmarks.device`.

Sections, each in a process of its own with a share of `--minutes`; one that fails, or is not through in its time, is a
row of the result, and the others go on. What a section leaves of its time is shared by those after it.

- `tests`: those with the marker `gpu`: kernels and their twins, layers, a training step and the tracker on the device
  against the CPU.
- `waits`: synchronisations of a frame that the network measures.
- `kernels`: kernels of the device and their twins.
- `presets`: frames per second of the tracker by preset, and of the weights `full`.
- `videos`: frames per second of one video, and of 16 in one go.
- `training`: steps per second by batch size, clips rendered on the device.

`--out FILE` keeps the rows as JSON, after every section. The table in Markdown is printed at the end. The exit code is
1 if something failed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import torch

from dvo.core.arguments import checked_device
from dvo.core.command_line import OneLineParser, names, positive_float
from dvo.core.errors import DvoError
from dvo.core.processes import bound
from dvo.core.threads import settle_threads
from dvo.data.files.output import scratch_folder, write_text
from eval.benchmarks.device.rows import Row, append_row, failures, read_rows, reason_of, table
from eval.benchmarks.device.sections import SECTIONS, Setting
from eval.suites.suite import ROOT

START = 5.0
"""Seconds of a section's time that are left for its process to start and to end."""


def run_section(name: str, device: str, seconds: float, quick: bool) -> list[Row]:
    """Rows of a section, which runs in a process of its own and is stopped when its time is up.

    Args:
        name: in :data:`eval.benchmarks.device.sections.SECTIONS`.
        device: name of the device.
        seconds: that it may take.
        quick: tiny sizes.
    """
    with scratch_folder("dvo-device") as folder:
        file, said = folder / "rows", folder / "said"
        command = [sys.executable, "-m", "eval.benchmarks.device", "--device", device, "--section", name]
        command += ["--rows", str(file), "--seconds", str(max(1.0, seconds - START)), *(["--quick"] if quick else [])]
        with said.open("wb") as output:
            process = subprocess.Popen(bound(command), cwd=ROOT, stdout=output, stderr=output, start_new_session=True)
            try:
                code: int | None = process.wait(seconds)
            except subprocess.TimeoutExpired:
                code = None
            finally:  # with all that it has started
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
        rows = read_rows(file)
        if code is None:
            rows.append(Row(name, "the rest", note=f"stopped after {seconds:.0f} s", failed=not rows))
        elif code:
            lines = said.read_text(encoding="utf-8", errors="replace").strip().splitlines() or [f"exit code {code}"]
            rows.append(Row(name, "the rest", note=lines[-1][:300], failed=True))
        return rows


def measure_section(name: str, device: torch.device, seconds: float, quick: bool, file: Path) -> None:
    """Run a section in this process.

    Args:
        name: in :data:`eval.benchmarks.device.sections.SECTIONS`.
        device: to measure.
        seconds: that it may take.
        quick: tiny sizes.
        file: its rows are appended there.
    """
    settle_threads()
    given = Setting(device, seconds, quick, time.perf_counter())
    try:
        for row in SECTIONS[name][1](given):
            append_row(file, row)
    except Exception as error:  # it is a row, whatever it is
        append_row(file, Row(name, "the rest", note=reason_of(error), failed=True))


def description(device: torch.device) -> dict[str, str]:
    """What the numbers were measured on.

    Args:
        device: measured.
    """
    module = getattr(torch, device.type)
    name = module.get_device_name(device) if hasattr(module, "get_device_name") else platform.processor()
    return {"device": str(device), "name": name or platform.machine(), "torch": torch.__version__}


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark, and print its table.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        Exit code: 0, 1 if something failed, 2 for invalid input.
    """
    parser = OneLineParser(prog="python -m eval.benchmarks.device", description=__doc__,
                           formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--device", required=True, help="cpu, cuda, cuda:N")
    parser.add_argument("--minutes", type=positive_float, help="of all sections together (9; with --quick 2)")
    parser.add_argument("--only", type=names, default=list(SECTIONS), metavar="NAMES", help=f"of {','.join(SECTIONS)}")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: does everything run?")
    parser.add_argument("--out", type=Path, metavar="FILE", help="rows as JSON")
    for name in ("--section", "--rows", "--seconds"):  # of the processes of the sections
        parser.add_argument(name, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    try:
        device = checked_device(given.device, "--device")
        unknown = [name for name in [*given.only, *([given.section] if given.section else [])] if name not in SECTIONS]
        if unknown:
            raise DvoError(f"no section {unknown[0]!r}", field="--only", remedy=f"give some of {', '.join(SECTIONS)}")
        if given.section:
            measure_section(given.section, device, float(given.seconds), given.quick, Path(given.rows))
            return 0
        if given.out is not None and not given.out.resolve().parent.is_dir():
            raise DvoError("its folder does not exist", field="--out", file=given.out, remedy="make it")
        rows = run_all(given.only, device, given.minutes or (2.0 if given.quick else 9.0), given.quick, given.out)
    except DvoError as error:
        print(f"device: error: {error}", file=sys.stderr)
        return 2
    print(table(rows))
    return 1 if failures(rows) else 0


def run_all(chosen: list[str], device: torch.device, minutes: float, quick: bool, out: Path | None) -> list[Row]:
    """Rows of sections, one after the other.

    Args:
        chosen: names of the sections.
        device: to measure.
        minutes: of all of them.
        quick: tiny sizes.
        out: file of JSON, written after every section; None for none.
    """
    end, rows = time.perf_counter() + 60 * minutes, list[Row]()
    for number, name in enumerate(chosen):
        shares = [SECTIONS[other][0] for other in chosen[number:]]
        left = max(0.0, end - time.perf_counter()) * shares[0] / sum(shares)
        start = time.perf_counter()
        found = run_section(name, str(device), left, quick)
        rows += found
        spent = time.perf_counter() - start
        print(f"{name}: {len(found)} rows, {failures(found)} failed, {spent:.0f} of {left:.0f} s", file=sys.stderr)
        if out is not None:
            content = {**description(device), "minutes": minutes, "quick": quick, "rows": [asdict(row) for row in rows]}
            try:
                write_text(out, json.dumps(content, indent=1) + "\n")
            except OSError as error:
                raise DvoError(
                    f"cannot be written ({error.strerror})", file=out, remedy="give another --out"
                ) from error
    return rows


if __name__ == "__main__":
    sys.exit(main())
