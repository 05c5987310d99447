"""Suites by what is given on the command line: names of configs, files, and folders of sequences."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.files.root import data_root
from dvo.data.readers.registry import is_dataset
from eval.suites.suite import SUITES, Sequence, Suite, read_suites


def load_suites(names: list[str], only: list[str] | None = None, stride: int | None = None) -> list[Suite]:
    """Suites by name or file (one name may stand for several, as ``axes`` does), or from the folder of a sequence.

    Args:
        only: names of sequences to keep, in this order.
        stride: in place of the suites' own.

    Raises:
        DvoError: no such suite or sequence, or a config with mistakes.
    """
    found = [suite for name in names for suite in _suites(name)]
    doubled = {suite.name for suite in found if sum(other.name == suite.name for other in found) > 1}
    if doubled:
        raise DvoError(f"twice the suite '{sorted(doubled)[0]}'", field="--suite", remedy="name each once")
    if only:
        known = list(dict.fromkeys(sequence.name for suite in found for sequence in suite.sequences))
        for name in only:
            if name not in known:
                of = ", ".join(suite.name for suite in found)
                raise DvoError(
                    f"no sequence '{name}' in the suite '{of}'",
                    field="--sequences",
                    remedy=f"choose from {', '.join(known)}",
                )
        found = [suite.only([n for n in only if any(n == s.name for s in suite.sequences)]) for suite in found]
        found = [suite for suite in found if suite.sequences]
    return [replace(suite, stride=stride) for suite in found] if stride else found


def suite_of_folder(path: Path) -> Suite:
    """A suite of the one sequence in a folder (TUM, EuRoC, KITTI, TartanAir, or images with ``groundtruth_tum.txt``),
    or of the sequences in its subfolders, by name.

    Args:
        path: of the folder.

    Raises:
        DvoError: neither the folder nor one of its subfolders has one of these layouts.
    """
    if not is_dataset(path) and (inner := [one for one in sorted(path.iterdir()) if one.is_dir() and is_dataset(one)]):
        name = path.resolve().name
        sequences = tuple(Sequence(one.name, str(one.resolve())) for one in inner)
        return Suite(name, f"the user's own sequences in {name}", sequences, time_limit=7200.0)
    if not is_dataset(path):
        raise DvoError(
            "no sequence in this folder or its subfolders",
            file=path,
            field="--suite",
            remedy="give a sequence with ground truth in the layout of TUM, EuRoC, KITTI or TartanAir",
        )
    name = path.resolve().name
    return Suite(name, f"the user's own sequence {name}", (Sequence(name, str(path.resolve())),), time_limit=7200.0)


def needs_data_folder(suites: list[Suite]) -> bool:
    """Return True if any sequence lies in the data folder, neither rendered nor named by an absolute path."""
    return any(
        not is_rendered(sequence) and not Path(sequence.path).is_absolute()
        for suite in suites
        for sequence in suite.sequences
    )


def folder_of_data(suites: list[Suite], given: Path | None) -> Path:
    """Data folder, which has to exist only if a sequence lies in it.

    Args:
        suites: of the evaluation.
        given: by the user; None for none.

    Raises:
        DvoError: not there, though it is needed.
    """
    if needs_data_folder(suites) or given is not None:
        return data_root(given)
    return Path()


def is_rendered(sequence: Sequence) -> bool:
    """Return True if a sequence is rendered on demand, not recorded."""
    return sequence.rendered is not None


def settle(suite: Suite, sequence: Sequence, data: Path) -> Sequence:
    """The sequence with the place where its files really are.

    Files may lie in a folder of the suite's name within the data folder; calibrations that ship with a config are
    looked up beside it.
    """
    if is_rendered(sequence) or Path(sequence.path).is_absolute():
        return sequence
    options = [Path(sequence.path), *(Path(top) / sequence.path for top in (suite.name, suite.name.upper()))]
    there = next((option for option in options if (data / option).exists()), options[0])
    calib = sequence.calib
    if calib and (SUITES / calib).is_file():
        calib = str(SUITES / calib)
    return replace(sequence, path=str(there), calib=calib)


def sequence_from(entry: dict[str, Any]) -> Sequence:
    """A sequence from its JSON form."""
    return _from(Sequence, entry)


def suite_from(entry: dict[str, Any]) -> Suite:
    """A suite from its JSON form."""
    return _from(Suite, {**entry, "sequences": tuple(sequence_from(one) for one in entry["sequences"])})


def config_names() -> list[str]:
    """Names of the suites in configs/eval."""
    return sorted(file.stem for file in SUITES.glob("*.yaml"))


def _suites(name: str) -> list[Suite]:
    if name not in config_names() and Path(name).is_dir():
        return [suite_of_folder(Path(name))]
    return read_suites(name)


def _from(kind: type, entry: dict[str, Any]) -> Any:
    known = {field.name for field in fields(kind)}
    return kind(**{name: _frozen(value) for name, value in entry.items() if name in known})


def _frozen(value: Any) -> Any:
    """JSON has no tuples, and frozen dataclasses are compared and hashed."""
    return tuple(_frozen(item) for item in value) if isinstance(value, (list, tuple)) else value
