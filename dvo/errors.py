"""The one exception type that dvo raises for bad input."""

from __future__ import annotations


class DvoError(Exception):
    """A problem with an input that the user can mend.

    Args:
        message: what is wrong, in one sentence.
        file: the file or folder concerned, if any.
        field: the field, option or row concerned, if any.
        remedy: what to do about it.

    ``str(error)`` is one line: ``file: field: message. remedy``.
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
