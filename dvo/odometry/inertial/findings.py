"""What a check of an inertial sensor says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from dvo.odometry.inertial.temporal import ImuAlignment


class Level(StrEnum):
    """How much a finding matters."""

    UNUSABLE = "unusable"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with an inertial sensor, or missing.

    Attributes:
        name: of the kind of fault, such as ``time offset``.
        level: how much it matters.
        text: what was found, with numbers.
        remedy: what to do about it.
    """

    name: str
    level: Level
    text: str
    remedy: str

    @property
    def rank(self) -> int:
        """0 for the gravest level."""
        return list(Level).index(self.level)

    def __str__(self) -> str:
        return f"{self.level}: {self.name}: {self.text}; {self.remedy}"


@dataclass(frozen=True)
class Found:
    """Numbers and findings of one part of a check.

    Attributes:
        values: by name; units stand in the names.
        findings: the gravest need not come first.
    """

    values: dict[str, Any]
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class SensorReport:
    """Check of an inertial sensor.

    Attributes:
        values: numbers by name, for a table; units stand in the names.
        findings: the gravest first.
        alignment: against the orientations of the camera; None without them.
    """

    values: dict[str, Any]
    findings: tuple[Finding, ...]
    alignment: ImuAlignment | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "findings", tuple(sorted(self.findings, key=lambda finding: finding.rank)))

    def beside(self, *findings: Finding | None) -> SensorReport:
        """The same with further findings.

        Args:
            findings: None for those that there are not.
        """
        return replace(self, findings=(*(one for one in findings if one is not None), *self.findings))

    @property
    def is_usable(self) -> bool:
        """No finding makes the samples unusable."""
        return all(finding.level != Level.UNUSABLE for finding in self.findings)

    def named(self, name: str) -> Finding | None:
        """Finding of a kind.

        Args:
            name: of the kind.

        Returns:
            None if there is none.
        """
        return next((finding for finding in self.findings if finding.name == name), None)
