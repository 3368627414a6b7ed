"""Checks of everything that a public op takes beside tensors, by the types its signature names.

One place for all: an argument annotated `int`, `float`, `bool` or `str` must be one, so must the elements of a sequence
and the fields of a dataclass or NamedTuple; None is allowed where the annotation says so. A tensor is no number: its
gradient would be lost, and on CUDA the call would wait for it. Tensors and ranges are left to the ops themselves.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Iterable, Sequence, Sized
from enum import Enum
from numbers import Integral, Real
from typing import Any

import torch

# What torch.compile hands over for sizes and floats of dynamic shapes counts as numbers. The plain type comes first.
_KINDS: dict[type, tuple[type, ...]] = {
    bool: (bool, torch.SymBool),
    int: (int, Integral, torch.SymInt),
    float: (float, int, Real, torch.SymInt, torch.SymFloat),
    str: (str,),
}


class Rule:
    """What a value must be. `fits` is asked at every call, `refuse` only to say what is wrong."""

    def fits(self, value: Any) -> bool:
        """Whether the value is what it must be."""
        raise NotImplementedError

    def refuse(self, function: str, argument: str, value: Any) -> None:
        """Raises the TypeError or ValueError of a value that doesn't fit."""
        raise NotImplementedError


def number_rules(function: Callable) -> dict[str, Rule]:
    """The rules of a function's arguments that are not plain tensors, by name."""
    return _rules(typing.get_type_hints(function))


def _rules(hints: dict[str, Any]) -> dict[str, Rule]:
    rules = {name: _rule(hint) for name, hint in hints.items() if name != "return"}
    return {name: rule for name, rule in rules.items() if rule is not None}


def _rule(hint: Any) -> Rule | None:
    """The rule of an annotation; None where there is nothing to check, as for tensors."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        others = [part for part in parts if part is not types.NoneType]
        rule = _rule(others[0]) if len(others) == 1 else None
        return None if rule is None else _Optional(rule)
    if origin in (Sequence, list, tuple):
        rule = _rule(parts[0])
        return None if rule is None else _Elements(rule, getattr(parts[0], "__name__", "sequences"))
    if not isinstance(hint, type) or issubclass(hint, torch.Tensor):
        return None
    if hint in _KINDS:
        return _Number(hint)
    if issubclass(hint, tuple) and set(typing.get_type_hints(hint).values()) == {float}:
        return _Elements(_Number(float), "float")  # intrinsics: any four numbers will do
    return _Object(hint)


class _Number(Rule):
    def __init__(self, kind: type):
        self.kind, self.allowed = kind, _KINDS[kind]

    def fits(self, value: Any) -> bool:
        return isinstance(value, self.allowed) and (self.kind is not int or _fits_64_bits(value))

    def refuse(self, function: str, argument: str, value: Any) -> None:
        if isinstance(value, self.allowed):
            raise ValueError(f"{function}: {argument} must fit 64 bits, got {value}")
        raise TypeError(f"{function}: {argument} must be {_with_article(self.kind)}, got {_kind_of(value)}")


class _Optional(Rule):
    def __init__(self, rule: Rule):
        self.rule = rule

    def fits(self, value: Any) -> bool:
        return value is None or self.rule.fits(value)

    def refuse(self, function: str, argument: str, value: Any) -> None:
        self.rule.refuse(function, argument, value)


class _Elements(Rule):
    def __init__(self, rule: Rule, name: str):
        self.rule, self.name = rule, name

    def fits(self, value: Any) -> bool:
        return _is_sequence(value) and all(map(self.rule.fits, value))

    def refuse(self, function: str, argument: str, value: Any) -> None:
        if not _is_sequence(value):
            raise TypeError(f"{function}: {argument} must be a sequence of {self.name}, got {_kind_of(value)}")
        wrong = next(part for part in value if not self.rule.fits(part))
        self.rule.refuse(function, f"each of {argument}", wrong)


class _Object(Rule):
    """Of a class: an instance of it whose fields, if it has any, are what their annotations say."""

    def __init__(self, kind: type):
        has_fields = dataclasses.is_dataclass(kind) or hasattr(kind, "_fields")
        self.kind, self.fields = kind, tuple(_rules(typing.get_type_hints(kind)).items()) if has_fields else ()

    def fits(self, value: Any) -> bool:
        return isinstance(value, self.kind) and all([rule.fits(getattr(value, name)) for name, rule in self.fields])

    def refuse(self, function: str, argument: str, value: Any) -> None:
        if not isinstance(value, self.kind):
            raise TypeError(f"{function}: {argument} must be {_with_article(self.kind)}, got {_kind_of(value)}")
        name, rule = next((name, rule) for name, rule in self.fields if not rule.fits(getattr(value, name)))
        rule.refuse(function, f"{argument}.{name}", getattr(value, name))


def _fits_64_bits(value: Any) -> bool:
    # Members of an enum do; torch.compile of torch 2.11 can't compare them.
    return isinstance(value, Enum) or -(2**63) <= value < 2**63


def _is_sequence(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return True
    others = str | bytes | dict | set | torch.Tensor
    return isinstance(value, Iterable) and isinstance(value, Sized) and not isinstance(value, others)


def _with_article(kind: type) -> str:
    return f"{'an' if kind.__name__[0] in 'aeiouAEIOU' else 'a'} {kind.__name__}"


def _kind_of(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        return "a torch.Tensor, by which the op has no gradient: pass its item()"
    return type(value).__name__
