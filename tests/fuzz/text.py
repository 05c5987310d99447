"""Mutations of text files: numbers, columns, rows, encodings, and structures of YAML."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

Random = np.random.Generator
SUFFIXES = frozenset(
    {".txt", ".csv", ".yaml", ".yml", ".freiburg", ".obj", ".mtl", ".gltf", ".json", ".ply", ".off", ".items"}
)
TOKENS = [
    "nan", "-nan", "inf", "-inf", "1e999", "-1e999", "1e308", "-1e308", "1e200", "1e-320", "0", "-0", "-1", "1e19",
    "9" * 5000, "9" * 400, "9" * 200, "-" + "9" * 25, "9" * 19, "9" * 18, "18446744073709551616", "1" * 16, "",
    "²", "１２", "1_000", "0x1F", "0b1", "1,5", "--", "+-1", "true", "null", "~", "None", "abc", "x" * 100_000, "'",
    '"', "0.5",
    "2024-13-45", "2024-02-30", "9999-99-99T99:99:99", "12:34:56", "0001-01-01",
    "[", "]", "{", "}", "[]", "{}", "[1, 2", "&a [*a]", "&a {x: *a}", "*nowhere", "? :", "- -", "!!int ''",
    "!!float x",
    "!!timestamp x", "!!bool x", "!!binary x", "!!set {a}", "!!python/object:os.system {}", "!!omap [a]", "|", ">", "@",
    "%", "../../../etc/passwd", "/dev/zero", "/dev/null", "/dev/stdin", "..", ".", "/", "~/x", "C:\\x", "a\0b", "\0",
    "é", "\u2028", "\ud800", "x" * 300 + ".png", "1e5", "1e-5", "1000000", "-1000", "1e12", "1e15", "3.5",
    "1e10", "65536",
]  # fmt: skip


def _read(file: Path) -> str:
    return file.read_bytes().decode("utf-8", errors="surrogateescape")


def _write(file: Path, text: str) -> None:
    try:
        file.write_bytes(text.encode("utf-8", errors="surrogateescape"))  # the bytes of a binary file as they were
    except UnicodeEncodeError:
        file.write_bytes(text.encode("utf-8", errors="surrogatepass"))


def _short(token: str) -> str:
    return repr(token if len(token) < 30 else f"{token[:20]}... ({len(token)} characters)")


def replace_token(file: Path, random: Random) -> str:
    """Replace a word or number, one or all of a column, by an odd one."""
    text = _read(file)
    found = list(re.finditer(r"[^\s,:\[\]{}]+", text))
    token = TOKENS[int(random.integers(len(TOKENS)))]
    if not found:
        _write(file, token)
        return f"text is {_short(token)}"
    word = found[int(random.integers(len(found)))]
    _write(file, text[: word.start()] + token + text[word.end() :])
    return f"{_short(word.group())} replaced by {_short(token)}"


def replace_number(file: Path, random: Random) -> str:
    """Replace a number by one of another size."""
    text = _read(file)
    found = list(re.finditer(r"-?\d+(\.\d*)?([eE][+-]?\d+)?", text))
    if not found:
        return replace_token(file, random)
    number = found[int(random.integers(len(found)))]
    factors = [-1.0, 0.0, 1e-12, 1e-3, 0.5, 2.0, 1e3, 1e6, 1e9, 1e12, 1e18, 1e100, 1e160, 1e300]
    value = float(number.group()[:300]) * factors[int(random.integers(len(factors)))]
    new = repr(value) if random.random() < 0.5 or not np.isfinite(value) else str(int(value))
    _write(file, text[: number.start()] + new + text[number.end() :])
    return f"{_short(number.group())} replaced by {_short(new)}"


def change_rows(file: Path, random: Random) -> str:
    """Remove, repeat, exchange or shuffle rows, or add one."""
    rows = _read(file).split("\n")
    i, j = random.integers(len(rows), size=2).tolist()
    way = ["removed", "repeated", "exchanged", "shuffled", "added", "only"][int(random.integers(6))]
    if way == "removed":
        del rows[i]
    elif way == "repeated":
        rows[i:i] = [rows[i]] * int(random.integers(1, 50))
    elif way == "exchanged":
        rows[i], rows[j] = rows[j], rows[i]
    elif way == "shuffled":
        random.shuffle(rows)
    elif way == "only":
        rows = [rows[i]]
    else:
        rows.insert(i, TOKENS[int(random.integers(len(TOKENS)))])
    _write(file, "\n".join(rows))
    return f"row {i} {way}"


def change_columns(file: Path, random: Random) -> str:
    """Remove, repeat or add a column, in one row or in all."""
    rows = _read(file).split("\n")
    chosen = range(len(rows)) if random.random() < 0.3 else [int(random.integers(len(rows)))]
    way, token = int(random.integers(3)), TOKENS[int(random.integers(len(TOKENS)))]
    place = random.random()
    for i in chosen:
        parts = re.split(r"([\s,]+)", rows[i])
        at = 2 * int(place * (len(parts) // 2 + 1))
        if way == 0:
            del parts[at : at + 2]
        else:
            parts[at:at] = [parts[at] if way == 1 and at < len(parts) else token, " "]
        rows[i] = "".join(parts)
    _write(file, "\n".join(rows))
    return f"column {('removed', 'repeated', 'added')[way]} in {len(chosen)} rows"


def change_encoding(file: Path, random: Random) -> str:
    """Write the text in another encoding, with a byte order mark, or with NUL bytes."""
    text = _read(file).encode("utf-8", errors="ignore").decode()
    way = int(random.integers(6))
    if way == 0:
        data = f"# Größe\n{text}".encode("latin-1", errors="replace")
    elif way == 1:
        data = text.encode("utf-16")
    elif way == 2:
        data = text.encode("utf-32")
    elif way == 3:
        data = b"\xef\xbb\xbf" + text.encode()
    elif way == 4:
        data = text.replace("\n", "\0\n").encode()
    else:
        data = text.replace("\n", "\r").encode()
    file.write_bytes(data)
    return ("Latin-1", "UTF-16", "UTF-32", "byte order mark", "NUL bytes", "carriage returns")[way]


def bend_row(file: Path, random: Random) -> str:
    """Put all of the text on one long row, or a very long row in front."""
    text = _read(file)
    _write(file, text.replace("\n", " ") if random.random() < 0.5 else "1 " * 200_000 + "\n" + text)
    return "one long row"


def _nested(opening: str, closing: str, depth: int) -> str:
    return opening * depth + closing * depth


def yaml_structure(file: Path, random: Random) -> str:
    """Nesting, aliases, documents and tags that parsers stumble over, alone or as the first key."""
    levels = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12))
    merges = "\n".join(f"m{i}: &m{i} {{<<: [{', '.join([f'*m{i - 1}'] * 10)}]}}" for i in range(1, 9))
    blocks = "\n".join(f"{'  ' * i}a:" for i in range(1500))
    bombs = {
        "aliases": f"a0: &a0 [x, x]\n{levels}\n",
        "merged aliases": f"m0: &m0 {{k: v}}\n{merges}\n",
        "flow nesting": f"n: {_nested('[', ']', 5000)}\n",
        "flow maps": f"n: {_nested('{a: ', '}', 5000)}\n",
        "block nesting": f"{blocks}\n",
        "sequence nesting": f"n: {'- ' * 3000}x\n",
        "long list": f"n: [{'1, ' * 20_000}1]\n",
        "recursive list": "n: &n [*n, 1]\n",
        "recursive map": "n: &n {n: *n}\n",
        "merge of itself": "n: &n\n  <<: *n\n",
        "list as key": "? [a, b]\n: c\n",
        "map as key": "? {a: b}\n: c\n",
        "number as key": "1: 2\n",
        "date": "d: 2024-13-45\n",
        "digits": f"d: {'9' * 5000}\n",
        "directive": "%YAML 9.9\n---\n",
        "unknown tag": "d: !mine x\n",
    }
    name = list(bombs)[int(random.integers(len(bombs)))]
    text, way = _read(file), int(random.integers(3))
    if way == 2:  # as the value of a key that is read
        keys = list(re.finditer(r"(?m)^(\s*[\w.]+): *\S.*$", text))
        value = bombs[name].strip().split("\n")
        if keys and len(value) == 1 and ": " in value[0]:
            key = keys[int(random.integers(len(keys)))]
            _write(file, text[: key.start()] + f"{key.group(1)}: {value[0].split(': ', 1)[1]}" + text[key.end() :])
            return f"{name} as the value of {key.group(1)}"
        if keys and name == "aliases":
            key = keys[int(random.integers(len(keys)))]
            _write(file, bombs[name] + text[: key.start()] + f"{key.group(1)}: *a11" + text[key.end() :])
            return f"{name} as the value of {key.group(1)}"
    _write(file, bombs[name] + (text if way else ""))
    return name + (" in front" if way else " alone")


def yaml_document(file: Path, random: Random) -> str:
    """Replace the document by one of another kind."""
    options = [
        "",
        "---\n---\n",
        "- 1\n- 2\n",
        "text",
        "42",
        "null",
        "{}",
        "[]",
        "a: 1\n---\nb: 2\n",
        "\t\n",
        ":",
        "2024-01-01",
    ]
    text = options[int(random.integers(len(options)))]
    _write(file, text)
    return f"document is {text!r}"


def yaml_type(file: Path, random: Random) -> str:
    """Give the value of a key another type."""
    text = _read(file)
    keys = list(re.finditer(r"(?m)^(\s*(?:- )?[\w.]+): *\S.*$", text))
    if not keys:
        return yaml_document(file, random)
    key = keys[int(random.integers(len(keys)))]
    values = [
        "{a: 1}", "[1, 2]", "[[1, 2], [3]]", "text", "''", "null", "true", "-1", "0", "1.5", "1e400", ".nan", "-.inf",
        "9" * 400, "2024-01-01", "[a, b]", "[{}]", "!!binary aGVsbG8=", "!!set {a, b}", "[null]", "{data: {data: 1}}",
        "[1, [2, [3]]]", "10000000000000000000000",
    ]  # fmt: skip
    value = values[int(random.integers(len(values)))]
    _write(file, text[: key.start()] + f"{key.group(1)}: {value}" + text[key.end() :])
    return f"{key.group(1).strip()} is {_short(value)}"


MUTATIONS: list[Callable[[Path, Random], str]] = [
    replace_token, replace_token, replace_token, replace_number, replace_number, change_rows, change_columns,
    change_encoding, bend_row,
]  # fmt: skip
YAML: list[Callable[[Path, Random], str]] = [yaml_structure, yaml_structure, yaml_document, yaml_type, yaml_type]
