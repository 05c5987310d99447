"""Texts from outside in messages and files: addresses without their secrets, characters that would steer a terminal."""

from __future__ import annotations

import difflib
import re
import sys
import traceback
import unicodedata
from collections.abc import Iterable, Iterator
from types import TracebackType
from urllib.parse import unquote

HIDDEN = "***"
"""What stands in the place of a secret value."""

# A path joins the slashes of "rtsp://", and a scheme may be mistyped; one letter before a colon is a drive. A colon or
# a scheme may have been forgotten.
_KNOWN = r"(?:rtsps?|rtmp[a-z]{0,2}|https?|s?ftps?|udp|tcp|srt|mms|h264\+rtsp|rstp|htpp?s?)"
_SCHEME = re.compile(rf"[a-z][a-z0-9+-]{{1,30}}:[/\\]+|(?<![\w./\\]){_KNOWN}[/\\]+|(?<!\S):[/\\]+", re.IGNORECASE)
_AT = str.maketrans("\uff20\ufe6b", "@@")
_PORT = re.compile(r"[^\s/@:]*:\d{1,5}(?![^\s/?#,.;:'\")\]])")
_USER = re.compile(r"[^\s/@:\[]+:")
# user:password@host without a scheme, or behind one without its colon
_BARE = re.compile(
    r"(?:(?<![^\s'\"(=])|(?<=//)|(?<=\\\\))(?![a-z]:[/\\])[\w+%-][\w.+%-]{0,200}:\S{0,1000}@(?=[\w\[-])", re.IGNORECASE
)
_HEADER = re.compile(r"\b(authorization|cookie)(\s*[:=]\s*)\S+(?: \S+)?", re.IGNORECASE)
_SECRET_PARTS = (
    "token", "secret", "pass", "pwd", "auth", "sig", "key", "cred", "session", "cookie", "jwt", "hmac", "hash",
    "ticket", "user", "login", "account", "nonce", "policy", "bearer", "usr", "psw", "pswd", "tkn",
)  # fmt: skip
_SECRET_NAMES = ("code", "pin", "otp", "sid", "k", "p", "pw", "s", "st", "u", "hdnts", "hdnea")
# Of a query, what does not look like a setting of a camera is taken for a secret, whatever its name.
_SETTINGS = (
    "channel", "stream", "subtype", "profile", "resolution", "size", "fps", "codec", "format", "transport", "camera",
)  # fmt: skip
_PLAIN = re.compile(r"[a-z]{0,5}|\d{1,5}(?:[x.]\d{1,5})?", re.IGNORECASE)
_UNNAMED = re.compile(r"(?<=[?&])[^\s=&#]{5,}[^\s=&#.,;:'\")\]](?=[.,;:'\")\]]*(?:[&#\s]|\Z))")
_STREAM_KEY = re.compile(r"(rtmp[a-z]{0,2}:[/\\]+[^\s/]+/[^\s/]+/)[^\s:,;'\")\]]+", re.IGNORECASE)
_ENCODED = re.compile(r"(?<=%3a%2f%2f)\S*%40", re.IGNORECASE)  # an address in the query of another
_PIECE = 5000  # characters of a line that are looked at together
_LONG = 20  # characters of a value that is taken for a secret whatever its name


def choice(name: object, names: Iterable[str], lead: str = "use one of") -> str:
    """Remedy for a name that is not known: the nearest one that is, and all of them.

    Args:
        name: as given.
        names: those that are known.
        lead: words before all of them.

    Example:
        >>> choice("pathces", ["pixels", "patches"])
        "did you mean 'patches'? Use one of pixels, patches"
    """
    known = list(names)
    near = difflib.get_close_matches(str(name)[:100], known, 1)
    listed = f"{lead} {', '.join(known)}"
    return f"did you mean '{near[0]}'? {listed[0].upper()}{listed[1:]}" if near else listed


def redacted(text: str, whole: bool = False) -> str:
    """Text without the user names, passwords and tokens of the addresses in it.

    What stands between ``scheme://`` and the last ``@`` is left out, as passwords may hold ``@``, ``/`` and blanks; of
    the values behind ``?name=``, those that may be secrets are replaced: all but short numbers, short words and
    settings of a camera. Addresses with any scheme count, and those whose slashes a path has joined.

    Args:
        text: any; lines are taken one by one.
        whole: the text is one address (or no address at all), so that blanks and line ends belong to it.

    Returns:
        The text; unchanged without such an address.

    Example:
        >>> redacted("rtsp://admin:p@ss/word@camera:554/live?token=42&channel=1")
        'rtsp://camera:554/live?token=***&channel=1'
    """
    if not any(mark in text for mark in "@=:%"):
        return text
    return _redacted_line(text, True) if whole else "\n".join(_redacted_line(line, False) for line in text.split("\n"))


def _redacted_line(line: str, whole: bool) -> str:
    if len(line) > _PIECE:  # the time of what follows grows with the square
        return "".join(_redacted_line(piece, whole) for piece in _pieces(line))
    line = _ENCODED.sub("", line)
    found = _SCHEME.search(line)
    while found:
        start = found.end()
        line = line[:start] + line[start + _userinfo(line[start:], whole) :]
        found = _SCHEME.search(line, start)
    if not _SCHEME.search(line):
        line = _BARE.sub("", line)
    line = _STREAM_KEY.sub(rf"\1{HIDDEN}", line)
    return _HEADER.sub(rf"\1\2{HIDDEN}", _without_values(line, whole))


def _pieces(line: str) -> Iterator[str]:
    """Parts of a long line, cut behind a blank where there is one."""
    start = 0
    while start < len(line):
        end = start + _PIECE
        blank = line.rfind(" ", start + _PIECE // 2, end) + 1
        end = blank if blank and end < len(line) else end
        yield line[start:end]
        start = end


def _userinfo(rest: str, whole: bool) -> int:
    """Length of what stands before the host, behind the scheme of an address."""
    rest = rest.translate(_AT)
    inner = rest.lstrip()
    run = rest if whole else rest[: len(rest) - len(inner)] + inner.split(maxsplit=1)[0] if inner else ""
    at = run.rfind("@")
    # A user name with a colon behind it begins a password, in which there may be blanks; host:554 does not.
    if (":" in run[: max(at, 0)]) or (at < 0 and _USER.match(inner) and not _PORT.match(inner)):
        at = rest.rfind("@")
    return at + 1


def _without_values(line: str, whole: bool) -> str:
    scheme = _SCHEME.search(line)
    start = len(line) if scheme is None else scheme.start()
    queried, in_address = _VALUES[whole]
    address = _hide(in_address, _hide(queried, line[start:]))
    return _hide(queried, line[:start]) + _UNNAMED.sub(HIDDEN, _hide(queried, address, strict=True))


def _hide(pairs: re.Pattern[str], text: str, strict: bool = False) -> str:
    """Replace the values of names that say, and of values that look, secret; if strict, all that are no settings."""
    found = pairs.search(text)
    while found:
        name, value = unquote(found[1]).lower(), found[2]
        start, end = found.span(2)
        is_named = name in _SECRET_NAMES or any(part in name for part in _SECRET_PARTS) or len(value) >= _LONG
        is_setting = any(part in name for part in _SETTINGS) and not name.endswith("id")
        is_odd = strict and not _PLAIN.fullmatch(value) and not is_setting
        if value and value != HIDDEN and (is_named or is_odd):
            text, start = text[:start] + HIDDEN + text[end:], start + len(HIDDEN)
        found = pairs.search(text, start)
    return text


def _values(before: str, blank: str) -> re.Pattern[str]:
    """``name=value`` behind one of some characters; marks at the end of the value are those of a sentence."""
    end = rf"(?=[:,.;'\")\]]*(?:[&{blank}]|\Z))"
    return re.compile(rf"(?<=[{before}])([^=&?;#/{blank}]{{1,80}})=([^&{blank}]*?){end}")


_VALUES = {whole: (_values("?&", blank), _values("?&;#/_", blank)) for whole, blank in ((False, r"\s"), (True, ""))}


_NO_BYTES = re.compile("[\ud800-\udc7f\udd00-\udfff]")


def in_utf8(text: str) -> str:
    """Text that can be written in UTF-8: bytes of a file's name that are no text become U+FFFD.

    Args:
        text: any, such as a name as the file system gives it.

    Example:
        >>> in_utf8("caf\\udce9")
        'caf\ufffd'
    """
    return text.encode("utf-8", "surrogateescape" if _is_escaped(text) else "replace").decode("utf-8", "replace")


def _is_escaped(text: str) -> bool:
    """True unless there are surrogates that stand for no byte."""
    return _NO_BYTES.search(text) is None


def visible(text: str, *, lines: bool = False) -> str:
    """Text in which characters that steer a terminal, or that nobody sees, are written as escapes.

    These are the control characters (escape sequences, bell, line ends), those that set the direction of writing, those
    of no width, and bytes that are no text. Letters of all scripts and emoji stay.

    Args:
        text: any.
        lines: line feeds stay.

    Example:
        >>> visible("a\\x1b[31m\\u202eb")
        'a\\\\x1b[31m\\\\u202eb'
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character
        if character.isascii() and character.isprintable() or character == "\n" and lines or _is_seen(text, position)
        else _escape(character)
        for position, character in enumerate(text)
    )


_FILLERS = "\u034f\u115f\u1160\u17b4\u17b5\u2800\u3164\uffa0"  # letters and marks that are blank
_FORMAT = "\u0600\u0601\u0602\u0603\u0604\u0605\u06dd\u070f\u08e2\U000110bd\U000110cd"  # have a shape
_JOINER, _STRETCH = "\u200d", "\ufe0f"


def _is_seen(text: str, position: int) -> bool:
    character = text[position]
    if character == _JOINER:  # of a family of emoji
        before, after = text[max(position - 2, 0) : position].rstrip(_STRETCH), text[position + 1 : position + 2]
        return bool(before and after) and unicodedata.category(before[-1]) in ("So", "Sk") and _is_symbol(after)
    if character in _FILLERS or "\u180b" <= character <= "\u180f":
        return False
    return unicodedata.category(character) not in ("Cc", "Cf", "Cs", "Cn", "Zl", "Zp") or character in _FORMAT


def _is_symbol(character: str) -> bool:
    return unicodedata.category(character) in ("So", "Sk")


def _escape(character: str) -> str:
    code = ord(character)
    short = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}.get(character)
    if short is not None:
        return short
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file name that is no text
        code -= 0xDC00
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def printable(value: object, *, lines: bool = False) -> str:
    """Text of a value as it may be printed: :func:`redacted` and :func:`visible`.

    Args:
        value: anything with a text.
        lines: line feeds stay.
    """
    return redacted(visible(str(value), lines=lines))


def encodable(text: str, encoding: str | None) -> str:
    """Text with escapes for what an encoding lacks.

    Args:
        text: any.
        encoding: of a stream; None for UTF-8.
    """
    return text.encode(encoding or "utf-8", "backslashreplace").decode(encoding or "utf-8")


def print_line(text: str = "", *, lines: bool = False, error: bool = False) -> None:
    """Print a line as :func:`printable` has it, and flush.

    Args:
        text: the line.
        lines: the text has several lines, none of which holds a name from outside.
        error: to the error stream.

    Raises:
        OSError: the stream cannot be written.
    """
    stream = sys.stderr if error else sys.stdout
    shown = encodable(printable(text, lines=lines), getattr(stream, "encoding", None))
    print(shown, file=stream, flush=True)


def first_line(error: BaseException, limit: int = 200) -> str:
    """First line of the text of an exception of another library, else its type.

    Args:
        error: the exception.
        limit: characters.
    """
    lines: Iterable[str] = (line.strip() for line in str(error).splitlines())
    return next((line[:limit] for line in lines if line), type(error).__name__)


def print_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print the traceback of an error that nobody handles as :func:`printable` has it; a value of ``sys.excepthook``.

    Args:
        kind, error, trace: of the exception.
    """
    text = "".join(traceback.format_exception(kind, error, trace)).rstrip("\n")
    print_line(text, lines=True, error=True)
