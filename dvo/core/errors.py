"""Exception that dvo raises for invalid input."""

from __future__ import annotations

import re

from dvo.core.text import printable, redacted, visible


class DvoError(Exception):
    """Invalid input that the user can fix.

    Args:
        message: description of the problem, in one sentence.
        file: file or folder with the problem, if any.
        field: field, option or row with the problem, if any.
        remedy: instruction to fix it.

    ``str(error)`` is one line: ``file: field: message. remedy``. It may be printed and stored as it is: addresses in it
    have no user names, passwords and tokens, and characters that would steer a terminal are escapes.

    Example:
        >>> str(dvo.DvoError("no such file", file="calib.txt", field="--calib", remedy="give a calibration file"))
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
        self.message, self.field, self.remedy = (
            _sentence(message),
            field and _sentence(field),
            remedy and _sentence(remedy),
        )
        where = None if file is None else redacted(visible(str(file)), whole=True)
        hidden = redacted(str(file), whole=True)
        self.file = file if file is None or hidden == str(file) else hidden
        head = "".join(f"{part}: " for part in (where, self.field) if part is not None)
        tail = f" {self.remedy[0].upper()}{self.remedy[1:]}." if self.remedy else ""
        super().__init__(f"{head}{self.message.rstrip('.')}.{tail}")


def _sentence(text: str) -> str:
    return printable(re.sub(r"\s*\n\s*", " ", str(text)))
