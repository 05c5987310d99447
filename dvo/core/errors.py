"""Exception that dvo raises for invalid input."""

from __future__ import annotations


class DvoError(Exception):
    """Invalid input that the user can fix.

    Args:
        message: description of the problem, in one sentence.
        file: file or folder with the problem, if any.
        field: field, option or row with the problem, if any.
        remedy: instruction to fix it.

    ``str(error)`` is one line: ``file: field: message. remedy``.

    Example:
        >>> str(DvoError("no such file", file="calib.txt", field="--calib", remedy="give a calibration file"))
        'calib.txt: --calib: no such file. Give a calibration file.'
    """

    def __init__(
        self,
        message: str,
        *,
        file: object | None = None,
        field: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.message, self.file, self.field, self.remedy = message, file, field, remedy
        where = "".join(f"{part}: " for part in (file, field) if part is not None)
        tail = f" {remedy[0].upper()}{remedy[1:]}." if remedy else ""
        super().__init__(f"{where}{message.rstrip('.')}.{tail}")
