"""Messages for validation errors: what was expected, what was given, and what to write instead."""

import difflib
import math
import re
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from holotorch.experiments.config.errors import MOST_MISTAKES, ConfigError, short
from holotorch.experiments.config.source import Key, Source

Model = TypeVar("Model", bound=BaseModel)

# What a field expects, by the beginning of the type of the error that pydantic reports.
_EXPECTED = {
    "int_": "a whole number",
    "float_": "a number",
    "finite_number": "a finite number",
    "string_": "text",
    "tuple_": "a list",
    "model_": "settings, as in {key: value}",
    "dict_": "settings, as in {key: value}",
}

_FILES = ("image", "path", "file", "kernel", "config")  # settings that name a file


def validated(source: Source, model: type[Model]) -> Model:
    """Settings from the data of a file. ConfigError with all mistakes, one line each, in the order of the file."""
    try:
        return model.model_validate(source.data)
    except ValidationError as error:
        entries = error.errors()
        listed = entries[:MOST_MISTAKES]
        mistakes = dict.fromkeys(describe(source, model, e) for e in listed if not _follows(e, listed))
        raise ConfigError(sorted(mistakes, key=position), len(entries) - len(listed)) from None


def _follows(entry: Any, others: list[Any]) -> bool:
    """Whether an error "too short" is due to invalid entries, which pydantic does not count and reports separately."""
    location = entry["loc"]
    inside = (other["loc"][: len(location)] == location != other["loc"] for other in others)
    return entry["type"] == "too_short" and any(inside)


def describe(source: Source, model: type[BaseModel], entry: Any) -> str:
    """One line for an entry of ``ValidationError.errors()``: position, key, expected and given value, and a hint."""
    key = _written_key(source, entry["loc"])
    kind, given = entry["type"], entry["input"]
    if kind == "extra_forbidden":
        chosen = source.positions.get((*key[:-1], "kind"), "").startswith("argument")
        return source.mistake(key, _unknown(model, entry["loc"], str(key[-1]), chosen))
    if kind == "missing":
        return source.mistake(key, "required, but missing")
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        expected = entry["ctx"].get("expected_tags", "")
        options = re.findall(r"'([^']+)'", expected)
        options = options or [tag for option in _options_at(model, entry["loc"]) for tag in _tags(option)]
        got = given.get("kind", "none") if isinstance(given, dict) else given
        hint = nearest(str(got), options)
        return source.mistake((*key, "kind"), f"expected one of {', '.join(options)}, got {short(got)}{hint}")
    if kind == "path":
        return source.mistake(key, entry["msg"])
    if kind in ("too_short", "too_long"):
        bound, name = ("least", "min_length") if kind == "too_short" else ("most", "max_length")
        number, got = entry["ctx"][name], entry["ctx"]["actual_length"]
        return source.mistake(key, f"expected at {bound} {number} {'entry' if number == 1 else 'entries'}, got {got}")
    expected = next((text for start, text in _EXPECTED.items() if kind.startswith(start)), None)
    expected = expected or entry["msg"].replace("Input should be ", "").removeprefix("expected ")
    near = difflib.get_close_matches(str(given)[:100].lower(), re.findall(r"'([^']+)'", expected), 1)
    # A text has a unit already, so only numbers get the hint that a unit is missing.
    hint = entry["ctx"].get("hint_of_text" if isinstance(given, str) else "hint", "") if kind == "quantity" else ""
    if kind.startswith("model_"):
        hint = _inner(model, entry["loc"], ".".join(map(str, key)), given)
    shown = "nothing" if given is None else "NaN" if isinstance(given, float) and math.isnan(given) else short(given)
    return source.mistake(key, f"expected {expected}, got {shown}" + (f"; did you mean {near[0]!r}?" if near else hint))


def _inner(model: type[BaseModel], location: tuple[str | int, ...], section: str, given: Any) -> str:
    """Hint at the setting within a section that is meant by a value in place of the section."""
    inside = list(dict.fromkeys(name for option in _options_at(model, location) for name in option.model_fields))
    files = [name for name in inside if name in _FILES]
    if isinstance(given, str) and files:
        return f"; did you mean {' or '.join(f'{section}.{name}' for name in files)}?"
    return f"; known: {', '.join(f'{section}.{name}' for name in inside)}" if inside else ""


def _unknown(model: type[BaseModel], location: tuple[str | int, ...], name: str, chosen: bool) -> str:
    """Why the section at ``location`` has no setting ``name``; ``chosen``: an argument alone sets its kind."""
    sections = _options_at(model, location[:-2])
    kinds = [tag for section in sections if name in section.model_fields for tag in _tags(section)]
    if kinds and len(location) > 2:
        kind = location[-2] if chosen else kinds[0]
        whole = f"to change the kind give the whole section, as in '{location[-3]}={{kind: {kind}}}'"
        return f"a setting of kind {' and '.join(kinds)}, not of {location[-2]}; {whole}"
    for section in _options_at(model, location[:-1]):
        if advice := getattr(section, "elsewhere", {}).get(name):
            return f"no setting of this kind of run: {advice}"
    known = [key for section in _options_at(model, location[:-1]) for key in section.model_fields]
    if len(location) == 1 and (inside := [f"{key}.{name}" for key in known if _has(model, key, name)]):
        return f"unknown setting; did you mean {' or '.join(inside)}?"
    key, colon, value = name.partition(":")
    if colon and key in known:
        return f"unknown setting; YAML wants a space after the colon, '{key}: {value}'"
    return "unknown setting" + nearest(name, known)


def _has(model: type[BaseModel], section: str, name: str) -> bool:
    """Whether a section of the file has a setting of this name."""
    return any(name in option.model_fields for option in _options_at(model, (section,)))


def position(mistake: str) -> tuple[int, int]:
    """Sort key of a mistake: its line and column; mistakes in arguments come after those in the file."""
    match = re.search(r":(\d+):(\d+): ", mistake)
    return (int(match[1]), int(match[2])) if match else (2**31, 0)


def _written_key(source: Source, location: tuple[str | int, ...]) -> Key:
    """The key in the file for a location in a pydantic error, which also contains the tags of unions."""
    key: list[str | int] = []
    value: Any = source.data
    for i, part in enumerate(location):
        tagged = isinstance(value, dict) and value.get("kind") == part and i < len(location) - 1
        if tagged and part not in value:
            continue
        if isinstance(part, int) and not isinstance(value, list):
            break  # a single value where a list is allowed
        key.append(part)
        try:
            value = value[part]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            value = None
    return tuple(key)


def _options_at(model: type[BaseModel], location: tuple[str | int, ...]) -> list[type[BaseModel]]:
    """The models that the section at ``location`` may have: several for a union whose tag is not in the location."""
    options: list[type[BaseModel]] = [model]
    for part in location:
        fields = [option.model_fields[str(part)] for option in options if str(part) in option.model_fields]
        if fields:
            annotation = fields[0].annotation
            types = getattr(annotation, "__args__", (annotation,))
            options = [each for each in types if isinstance(each, type) and issubclass(each, BaseModel)]
        else:  # the tag of a union
            options = [option for option in options if part in _tags(option)]
    return options


def _tags(option: type[BaseModel]) -> tuple[str, ...]:
    return getattr(option.model_fields["kind"].annotation, "__args__", ()) if "kind" in option.model_fields else ()


def nearest(word: str, options: list[str]) -> str:
    """A hint that names the option most similar to ``word``, ignoring case, or else all options."""
    near = difflib.get_close_matches(word, options, 1) or difflib.get_close_matches(word.lower(), options, 1)
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(options)}" if options else ""
