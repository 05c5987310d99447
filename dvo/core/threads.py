"""Number of threads, and their behaviour while they wait for each other.

OpenMP threads that wait spin by default: with another busy process on the same cores, the others spin for whole time
slices until the one that is not running comes back, and tracking gets 30 to 100 times slower. Threads that sleep until
they are woken (passive waiting) do not, and lose little on an idle machine if they spin for some microseconds before.
OpenMP reads its settings when torch is imported, so ``import dvo`` chooses them, whoever sets the number of threads.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

WAIT_POLICY = "OMP_WAIT_POLICY"
NUMBERS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
_WAITING = (WAIT_POLICY, "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  # of OpenMP, of its GNU and of its LLVM library
_CHOICE = {WAIT_POLICY: "PASSIVE", "GOMP_SPINCOUNT": "1000"}  # turns of GNU's loop, 25 to 50 us, before a thread sleeps
CGROUPS = Path("/sys/fs/cgroup")
"""Folder of the control groups."""
MEMBERSHIP = Path("/proc/self/cgroup")
"""File that lists the control groups of this process."""


@dataclass(frozen=True)
class Threads:
    """Threads of this process.

    Attributes:
        count: threads of torch.
        chosen_by: origin of the count: name of an environment variable, ``dvo``, or ``program`` (it called
            ``torch.set_num_threads``).
        wait_policy: ``passive``, or the setting of the environment; ``spinning (default)`` without one.
        waits_by: origin of the wait policy: name of an environment variable, ``dvo``, or ``OpenMP``.
        cores: cores that this process may use.
    """

    count: int
    chosen_by: str
    wait_policy: str
    waits_by: str
    cores: int


def available_cores() -> int:
    """Number of cores that this process may use: those of its affinity, within the quota of its control group.

    Returns:
        1 or more; independent of the load.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.floor(min(cores, processor_quota(MEMBERSHIP, CGROUPS))))


def thread_rule(cores: int) -> int:
    """Number of threads on a machine: one per core, at most 4.

    A fixed rule, because results depend on the number in their last digits. On two cores, two threads are 1.4 to
    1.6 times as fast as one (``python -m eval.benchmarks.threads``).

    Args:
        cores: that the process may use.

    Returns:
        Number of threads.
    """
    return min(cores, 4)


def share_cores(jobs: int | None) -> tuple[int, int]:
    """Number of processes at a time, and threads of each, in which they share the cores of this process.

    A number in the environment (``OMP_NUM_THREADS``, ``MKL_NUM_THREADS``) is that of each process.

    Args:
        jobs: processes at a time; None for as many as leave each the threads that it would have alone.

    Returns:
        Processes, and threads of each; both 1 or more, and independent of the load.
    """
    cores = available_cores()
    given = next((int(text) for name in NUMBERS if (text := os.environ.get(name, "")).isdecimal() and int(text)), None)
    threads = given or thread_rule(cores if jobs is None else max(1, cores // jobs))
    return jobs or max(1, cores // threads), threads


def wait_passively() -> bool:
    """Choose passive waiting after a short spin, unless the environment says otherwise; before torch is imported.

    Returns:
        True if threads will wait as chosen by dvo or by the environment; False if torch is imported already, without a
        choice.
    """
    if any(name in os.environ for name in _WAITING):
        return True
    if "torch" in sys.modules:
        return False
    os.environ.update(_CHOICE)
    _state["waits_by"] = "dvo"
    return True


def settle_threads() -> Threads:
    """Set the number of threads of torch and OpenCV by the rule of the machine, once per process.

    A number in the environment (``OMP_NUM_THREADS``, ``MKL_NUM_THREADS``) and one that the program has set through
    ``torch.set_num_threads`` (other than torch's default) are kept. Later calls change nothing, so a program may set
    its own number after the first.

    Returns:
        The threads of this process.

    Warns:
        UserWarning: torch was imported before dvo, its threads are several, and they spin.
    """
    passive = wait_passively()
    if "chosen_by" in _state:
        return current_threads()
    import cv2
    import torch

    by = next((name for name in NUMBERS if name in os.environ), None)
    if by is None and torch.get_num_threads() in default_counts():
        by = "dvo"
        count = min(thread_rule(available_cores()), torch.get_num_threads())  # torch's default leaves out hyperthreads
        torch.set_num_threads(count)
        if cv2.getNumThreads() == cv2.getNumberOfCPUs():
            cv2.setNumThreads(count)
    _state["chosen_by"] = by or "program"
    if not passive and torch.get_num_threads() > 1:
        warnings.warn(
            f"torch was imported before dvo, so its {torch.get_num_threads()} threads spin while they wait, which "
            f"is slow beside other busy programs: import dvo before torch, or set {WAIT_POLICY}=PASSIVE",
            stacklevel=3,
        )
    return current_threads()


def current_threads() -> Threads:
    """Threads of this process as they are now.

    Returns:
        Without torch imported, the number that it would get.
    """
    torch = sys.modules.get("torch")
    cores = available_cores()
    by = _state.get("chosen_by") or next((name for name in NUMBERS if name in os.environ), "dvo")
    if torch is not None:
        count = torch.get_num_threads()
    else:
        count = int(os.environ[by]) if os.environ.get(by, "").isdigit() else thread_rule(cores)
    waiting = next((name for name in _WAITING if name in os.environ), None)
    if waiting is None:
        return Threads(count, by, "spinning (default)", "OpenMP", cores)
    policy = os.environ[waiting].lower() if waiting == WAIT_POLICY else f"{waiting}={os.environ[waiting]}"
    return Threads(count, by, policy, _state.get("waits_by", waiting), cores)


def process_environment(count: int, environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment variables of a process with a number of threads that wait passively.

    Args:
        count: threads of torch, MKL and OpenBLAS.
        environment: to start from, None for that of this process; its wait policy is kept.

    Returns:
        Environment of the process.
    """
    variables = dict(os.environ if environment is None else environment)
    variables |= dict.fromkeys((*NUMBERS, "OPENBLAS_NUM_THREADS"), str(count))
    if not any(name in variables for name in _WAITING):
        variables |= _CHOICE
    return variables


def default_counts() -> set[int]:
    """Numbers of threads that torch chooses by itself: the cores of the affinity, or those without hyperthreads."""
    if not hasattr(os, "sched_getaffinity"):
        return {os.cpu_count() or 1}
    allowed = os.sched_getaffinity(0)
    topology = Path("/sys/devices/system/cpu")
    siblings = {_text(topology / f"cpu{core}" / "topology" / "thread_siblings_list") or str(core) for core in allowed}
    return {len(allowed), len(siblings)}


_state: dict[str, str] = {}  # origins of the choices made in this process


def processor_quota(membership: Path, root: Path) -> float:
    """Processor time that the control group of a process may use.

    Args:
        membership: file that lists the control groups of the process.
        root: folder of the control groups.

    Returns:
        Cores; infinity without a limit.
    """
    limit = math.inf
    for folder, is_first in group_folders(membership, root, "cpu"):
        if is_first:
            quota, period = _text(folder / "cpu.cfs_quota_us"), _text(folder / "cpu.cfs_period_us")
        else:
            quota, _, period = _text(folder / "cpu.max").partition(" ")
        if quota.isdigit() and period.isdigit() and int(period) > 0:
            limit = min(limit, int(quota) / int(period))
    return limit


def group_folders(membership: Path, root: Path, controller: str) -> Iterator[tuple[Path, bool]]:
    """Folders of the control groups of a process that may limit it.

    Args:
        membership: file that lists the control groups of the process.
        root: folder of the control groups.
        controller: such as ``cpu`` or ``memory``.

    Yields:
        The folder of each level, and whether its files are those of the first version of control groups.
    """
    for line in _text(membership).splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and controller not in controllers.split(","):
            continue
        base = root / controllers if controllers else root
        # A container may see its own group as the root, or see the path of the host: try all levels.
        for level in (path.strip("/"), *map(str, Path(path.strip("/")).parents)):
            yield base / level, bool(controllers)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
