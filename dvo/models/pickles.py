"""PyTorch's pickled files, read as plain tensors and containers: no code of the file runs."""

from __future__ import annotations

import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.core.limits import limit_error

MAX_BYTES = 2 * 1024**3
"""Largest file; the training state of the ``full`` network has 60 MB."""


def load_pickle(file: str | Path, remedy: str) -> Any:
    """Read a file that ``torch.save`` wrote, onto the CPU.

    Args:
        file: path.
        remedy: for messages.

    Returns:
        Tensors, containers, texts and numbers.

    Raises:
        DvoError: no such file; cut or damaged; objects other than tensors and containers in it; compressed entries,
            which ``torch.save`` never writes and which may unpack to any size.
    """
    path = Path(file)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy=remedy)
    if path.stat().st_size > MAX_BYTES:
        raise DvoError(f"larger than {MAX_BYTES // 1024**3} GB", file=path, remedy=remedy)
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > path.stat().st_size:
                raise DvoError("holds compressed entries", file=path, remedy=remedy)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on damaged headers, before the error
            return torch.load(path, map_location="cpu", weights_only=True)
    except DvoError:
        raise
    except Exception as error:  # the readers of damaged archives and pickles raise errors of many types
        message = f"cannot be read as plain tensors ({_reason(error)})"
        raise limit_error(error, path) or DvoError(message, file=path, remedy=remedy) from None


# What torch says of files that it refuses, without its advice to read them unchecked.
_REASONS = (
    (r"GLOBAL (\S{1,80})", "it holds objects of the type {}, which could run code"),
    (
        r"(?:instruction|opcode|operand|[Uu]nsupported)\D{0,40}(\d+)",
        "it holds instruction {}, which plain tensors do not need",
    ),
    (r"legacy \.tar|TorchScript|torch\.jit", "it is of a format that could run code"),
)
_ADVICE = re.compile(r"weights_only|allow_pickle|unsafe|arbitrary code|trust|safe_globals|full_load", re.IGNORECASE)


def _reason(error: Exception) -> str:
    """Reason of a refusal in a few words, never an advice to switch a check off."""
    text = " ".join(str(error).split())
    for pattern, reason in _REASONS:
        found = re.search(pattern, text)
        if found and _ADVICE.search(text):
            return reason.format(*found.groups())
    sentences = [part for part in re.split(r"(?<=[.!?:]) ", text) if part and not _ADVICE.search(part)]
    said = next((part for part in sentences if any(map(str.isalpha, part))), "")
    return said.rstrip(".:")[:200] or "it is damaged, or holds more than tensors and containers"


def check_plain(tensors: dict[str, Any], file: object, remedy: str) -> None:
    """Check that all values are tensors that can be copied into a network: dense, on the CPU, by names.

    Args:
        tensors: by name.
        file, remedy: for messages.

    Raises:
        DvoError: another kind of value, with its name.
    """
    for name, value in tensors.items():
        plain = isinstance(name, str) and isinstance(value, Tensor)
        if not plain or value.layout != torch.strided or value.device.type != "cpu" or value.is_quantized:
            raise DvoError("is no dense tensor", file=file, field=str(name)[:100], remedy=remedy)
