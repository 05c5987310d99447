"""Types of the arguments of public functions, checked by their annotations: one error that names the argument."""

from __future__ import annotations

import collections.abc
import inspect
import os
import re
from collections.abc import Callable, Iterable
from functools import wraps
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar, get_origin

from dvo.core.errors import DvoError
from dvo.core.settings import shown

P = ParamSpec("P")
R = TypeVar("R")
Rule = tuple[str, Callable[[Any], bool]]
"""Noun for messages, and test of a value."""

DEVICE = "torch.device"
_NOUNS: dict[str, Rule] = {
    "str": ("a text", lambda value: isinstance(value, str) and "\0" not in value),
    "Path": ("a path", lambda value: isinstance(value, os.PathLike)),
    "int": ("a whole number", lambda value: isinstance(value, Integral) and not _is_bool(value)),
    "float": ("a number", lambda value: isinstance(value, Real) and not _is_bool(value)),
    "bool": ("true or false", lambda value: _is_bool(value)),
    "Callable": ("a function", callable),
    "Iterable": ("something to iterate over", lambda value: _iterates(value)),
    "None": ("None", lambda value: value is None),
}
_FREE = ("Any", "object", "T")  # annotations of arguments that may be anything


def checked_arguments(function: Callable[P, R], *, skip: tuple[str, ...] = ()) -> Callable[P, R]:
    """Check the arguments of a function against its annotations when it is called: a decorator.

    Checked are texts, paths, numbers, truth values, functions, iterables, devices of torch and classes that the module
    of the function knows; of any other annotation only that None is not given where it does not stand.

    Args:
        function: whose annotations are texts (``from __future__ import annotations``).
        skip: arguments that the function checks itself.

    Returns:
        The function, which raises a :class:`DvoError` for an argument of another type.

    Example:
        >>> @checked_arguments
        ... def repeat(text: "str", count: "int | None" = None) -> "str":
        ...     return text * (count or 1)
        >>> repeat("a", "b")
        Traceback (most recent call last):
        dvo.core.errors.DvoError: count: must be a whole number or None, got 'b'. See the description of the argument.
    """
    signature = inspect.signature(function)
    several = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
    annotated = {
        name: _parts(parameter.annotation)
        for name, parameter in signature.parameters.items()
        if isinstance(parameter.annotation, str) and parameter.kind not in several and name not in skip
    }

    @wraps(function)
    def call(*args: P.args, **keywords: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **keywords).arguments
        except TypeError:  # a missing or an unknown argument: the message of Python
            return function(*args, **keywords)
        for name, value in given.items():
            if name in annotated:
                _check(name, value, annotated[name], inspect.unwrap(function))
        return function(*args, **keywords)

    return call


def checked_device(device: Any, field: str = "device") -> Any:
    """The device of torch of a name, if tensors can be made there.

    Args:
        device: name or ``torch.device``.
        field: for messages.

    Returns:
        The ``torch.device``.

    Raises:
        DvoError: not a device, one that this machine or this build of torch does not have, or ``meta``, which has no
            values.
    """
    import torch

    remedy = "give cpu, cuda, cuda:N or mps"
    if not isinstance(device, str | torch.device):
        raise DvoError(f"must be a device, got {shown(device)}", field=field, remedy=remedy)
    try:
        found = torch.device(device)
    except (RuntimeError, ValueError):
        raise DvoError(f"no device: {shown(device)}", field=field, remedy=remedy) from None
    if found.type == "meta":
        raise DvoError("'meta' holds no values, nothing can be computed there", field=field, remedy=remedy)
    if found.type != "cpu":
        try:
            torch.zeros(1, device=found)
        except Exception as error:  # every backend has its own
            reason = next(iter(str(error).strip().splitlines()), "") or type(error).__name__
            message = f"'{found}' cannot be used ({reason[:200]})"
            raise DvoError(message, field=field, remedy="give another device, such as cpu") from error
    return found


def _parts(annotation: str) -> tuple[str, ...]:
    """Alternatives of an annotation, without what stands in brackets."""
    plain = annotation.strip("'\"")
    while "[" in plain:
        plain, before = re.sub(r"\[[^\[\]]*\]", "", plain), plain
        if plain == before:
            break
    return tuple(part.strip() for part in plain.split("|"))


def _check(name: str, value: Any, parts: tuple[str, ...], function: Callable[..., Any]) -> None:
    if any(part in _FREE for part in parts):
        return
    if DEVICE in parts:
        if not (value is None and "None" in parts):
            checked_device(value, name)
        return
    rules = [_NOUNS.get(part) or _rule(part, function) for part in parts]
    known = [rule for rule in rules if rule is not None]
    if any(fits(value) for _, fits in known) or (len(known) < len(rules) and value is not None):
        return
    wanted = " or ".join(noun for noun, _ in known) if len(known) == len(rules) else "given"
    raise DvoError(f"must be {wanted}, got {shown(value)}", field=name, remedy="see the description of the argument")


def _rule(part: str, function: Callable[..., Any]) -> Rule | None:
    """Noun and test of a name that the module of a function knows; None for what cannot be tested."""
    if part in ("Iterator", "Sequence", "Collection"):
        return _NOUNS["Iterable"]
    found = getattr(function, "__globals__", {}).get(part)
    if get_origin(found) is collections.abc.Callable:
        return _NOUNS["Callable"]
    if not isinstance(found, type):
        return None
    return f"{'an' if part[0] in 'AEIOU' else 'a'} {part}", _instances(found)


def _instances(kind: type) -> Callable[[Any], bool]:
    """Test for instances of a class, or for the methods of a protocol."""
    if not getattr(kind, "_is_protocol", False):
        return lambda value: isinstance(value, kind)
    methods = [name for name, member in vars(kind).items() if callable(member) and not name.startswith("_")]
    return lambda value: all(callable(getattr(value, name, None)) for name in methods)


def _is_bool(value: Any) -> bool:
    kind = type(value)  # of NumPy without importing it
    return isinstance(value, bool) or (kind.__module__ == "numpy" and kind.__name__ in ("bool", "bool_"))


def _iterates(value: Any) -> bool:
    return isinstance(value, Iterable) or hasattr(value, "__getitem__")
