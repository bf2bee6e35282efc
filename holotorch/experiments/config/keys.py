"""Every key of a configuration with its values, default and meaning, from the settings themselves."""

import inspect
import re
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from holotorch.experiments.config.meanings import MEANINGS
from holotorch.experiments.config.settings import kelvin, metres, radians

_LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
# Quantity by the name of the validator that reads its unit.
_QUANTITIES = {metres.__name__: "length", radians.__name__: "phase", kelvin.__name__: "temperature"}
_UNITS = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))


class Key(NamedTuple):
    """One key of a kind of configuration."""

    name: str  # with dots, such as solver.max_steps
    values: str  # allowed values, in words
    default: str  # as YAML; "required", or "" for a section
    meaning: str


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[Key]:
    """All keys of ``model`` and its sections in their order; those of alternative sections come one after the other."""
    for name, field in model.model_fields.items():
        sections = list(_sections(field.annotation))
        quantity = _quantity([field.annotation, *field.metadata])
        if not sections:
            values = _values(field.annotation, field.metadata, quantity)
            yield Key(prefix + name, values, _default(field, quantity), meaning(model, name))
            continue
        many = "list of sections" if _is_list(field.annotation) else "section"
        inside = " | ".join(dict.fromkeys(_first_line(section) for section in sections))
        yield Key(prefix + name, many + (" or null" if field.default is None else ""), "", inside)
        yield from _merged([list(keys(section, f"{prefix}{name}.")) for section in sections], sections)


def _merged(alternatives: Sequence[list[Key]], sections: Sequence[type[BaseModel]]) -> Iterator[Key]:
    """Keys of alternative sections, each once; a key that not all of them have names the kinds that do."""
    if len(sections) == 1:
        yield from alternatives[0]
        return
    owners: dict[Key, list[str]] = {}
    for section, each in zip(sections, alternatives, strict=True):
        for key in each:
            owners.setdefault(key, []).extend(typing.get_args(section.model_fields["kind"].annotation))
    every = len({kind for kinds in owners.values() for kind in kinds})
    first = next(iter(owners))
    yield first._replace(values=" | ".join(key.values for key in owners if key.name == first.name))
    for key, kinds in owners.items():
        if key.name != first.name:
            yield key if len(kinds) == every else key._replace(meaning=f"({', '.join(kinds)}) {key.meaning}")


def meaning(model: type[BaseModel], name: str) -> str:
    """What a key means: the description of the field, the part of the docstring about it, or an entry of MEANINGS."""
    if (description := model.model_fields[name].description) is not None:
        return description
    for owner in model.__mro__:
        if not issubclass(owner, BaseModel) or name not in owner.model_fields:
            break
        if (text := MEANINGS.get(f"{owner.__name__}.{name}")) is not None:
            return text
        if text := _explained(owner, name):
            return text
    return MEANINGS.get(name, "")


def _explained(model: type[BaseModel], name: str) -> str:
    """What the docstring of a section says after ````name````: up to the next name or the end of the sentence."""
    text = " ".join((inspect.getdoc(model) or "").split())
    match = re.search(rf"``{name}``(?:, ``\w+``)*(?: \([^)]*\))?: (.+?)(?=(?:[;.] ``\w+``)|$)", text)
    return match[1].rstrip(".").replace("``", "") if match else ""


def _sections(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif typing.get_origin(annotation) in (tuple, typing.Annotated, typing.Union, types.UnionType):
        for each in typing.get_args(annotation):
            yield from _sections(each)


def _is_list(annotation: Any) -> bool:
    return typing.get_origin(annotation) is tuple or any(_is_list(each) for each in typing.get_args(annotation))


def _quantity(parts: Sequence[Any]) -> str:
    """Name of the quantity with a unit that an annotation, or one inside it, describes; "" for a plain number."""
    for part in parts:
        if isinstance(part, BeforeValidator) and (name := _QUANTITIES.get(getattr(part.func, "__name__", ""))):
            return name
        if quantity := _quantity([*typing.get_args(part), *getattr(part, "__metadata__", ())]):
            return quantity
    return ""


def _values(annotation: Any, metadata: Sequence[Any], quantity: str) -> str:
    """Allowed values, in words."""
    origin, inside = typing.get_origin(annotation), typing.get_args(annotation)
    limits = _limits(metadata)
    if origin is typing.Annotated:
        return _values(inside[0], [*inside[1:], *metadata], quantity)
    if origin is typing.Literal:
        return " | ".join(map(str, inside))
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_values(each, metadata, quantity) if each is not type(None) else "null" for each in inside)
    if origin is tuple:
        items = [_values(each, (), quantity) for each in inside if each is not Ellipsis]
        return f"list of {items[0]}" if Ellipsis in inside else f"[{', '.join(items)}]"
    words = {bool: "true | false", int: "whole number", str: "text", float: quantity or "number"}
    return " ".join(filter(None, (words.get(annotation, "value"), limits)))


def _limits(metadata: Sequence[Any]) -> str:
    """The tightest lower bound and the tightest upper bound, in words."""
    every = [(name, getattr(each, name)) for each in _flat(metadata) for name in _LIMITS if hasattr(each, name)]
    lower = [(value, name) for name, value in every if name in ("ge", "gt")]
    upper = [(value, name) for name, value in every if name in ("le", "lt")]
    # Of two equal bounds the tighter one is that without the equality.
    tightest = [max(lower, key=lambda bound: (bound[0], bound[1] == "gt"))] if lower else []
    tightest += [min(upper, key=lambda bound: (bound[0], bound[1] == "le"))] if upper else []
    return " and ".join(f"{_LIMITS[name]} {value:g}" for value, name in tightest)


def _flat(metadata: Sequence[Any]) -> Iterator[Any]:
    for each in metadata:
        yield from _flat(each.metadata) if isinstance(each, FieldInfo) else [each]


def _default(field: FieldInfo, quantity: str) -> str:
    return "required" if field.default is PydanticUndefined else _yaml(field.default, quantity == "length")


def _yaml(value: Any, length: bool) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, tuple):
        return f"[{', '.join(_yaml(each, length) for each in value)}]"
    if length and isinstance(value, float) and value:
        unit, size = next((each for each in _UNITS if abs(value) >= 0.9 * each[1]), _UNITS[-1])
        return f"{value / size:.10g} {unit}"
    return f"{value:.6g}" if isinstance(value, float) else str(value) or "''"


def _first_line(model: type[BaseModel]) -> str:
    return (inspect.getdoc(model) or "").splitlines()[0].replace("``", "").rstrip(".")
