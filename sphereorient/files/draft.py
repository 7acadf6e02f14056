"""YAML files for people to go on with: each key explained, those that nobody could measure left open."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sphereorient.errors import SettingsError, refusal
from sphereorient.files.whole_file import sealed
from sphereorient.files.yaml_file import assigned, flow, refuse_unknown, short

WIDTH = 120  # characters of a line


@dataclass(frozen=True, kw_only=True)
class DraftKey:
    """A key of a draft."""

    name: str  # with its parent: sphere.diameter
    value: Any = ...  # ...: not known
    comment: str  # unit, meaning, what was measured
    example: Any = None  # of a key that is not known
    asked: bool = False  # whether the file is of no use without it


def given(keys: Sequence[DraftKey], changes: Iterable[str]) -> list[DraftKey]:
    """Return keys with values `name=value`, YAML, put in; SettingsError for an unknown name or no YAML."""
    known = {key.name: key for key in keys}
    for text in changes:
        name, found = assigned(text)
        if name not in known:
            raise SettingsError(refuse_unknown(name, known, "--set"))
        key = known[name]
        example = key.example if key.value in (..., None) else key.value
        if found is not None and not _alike(found, example):
            expected = f"a value like {flow(example)[:60]}"
            raise SettingsError(refusal(f"--set {name}", expected=expected, got=short(found), do="write such a one"))
        known[key.name] = replace(key, value=found)
    return list(known.values())


def _alike(value: Any, example: Any) -> bool:
    """Return whether a value is of an example's kind: a number, words, yes or no, a list or a mapping of such."""
    if isinstance(example, Mapping):
        some = next(iter(example.values()), None)
        return isinstance(value, Mapping) and all(_alike(part, example.get(name, some)) for name, part in value.items())
    if isinstance(example, list | tuple):
        return isinstance(value, list) and all(_alike(part, example[0]) for part in value)
    if isinstance(example, bool) or not isinstance(example, int | float):
        return example is None or isinstance(value, type(example))
    return isinstance(value, int | float) and not isinstance(value, bool)


def open_keys(keys: Iterable[DraftKey]) -> list[DraftKey]:
    """Return the keys that are asked for and not known."""
    return [key for key in keys if key.asked and key.value is ...]


def draft_yaml(schema: str, keys: Sequence[DraftKey], head: str = "") -> str:
    """Return the text of a file: keys not known are comments, with an example; those asked for say so."""
    lines = [f"# {line}" for line in head.splitlines()] + [f"schema: {schema}"]
    for parent in dict.fromkeys(key.name.partition(".")[0] for key in keys):
        children = [key for key in keys if key.name.partition(".")[0] == parent]
        if children[0].name == parent:
            lines += _line(children[0], parent, "")
            continue
        known = any(key.value is not ... for key in children)
        lines.append(f"{'' if known else '#'}{parent}:")
        for key in children:
            lines += _line(key, key.name.partition(".")[2], "  ")
    return sealed("\n".join([*lines, ""]))


def _line(key: DraftKey, name: str, indent: str) -> list[str]:
    known = key.value is not ...
    values = key.value if known else key.example
    comment = f"# {'' if known or not key.asked else 'WRITE THIS: '}{key.comment}"
    mark = indent if known else f"{indent}#"  # without the "#" the key stands where it belongs
    if isinstance(values, list) and values and isinstance(values[0], Mapping):
        return [f"{mark}{name}:  {comment}", *(f"{mark}  - {flow(value)}" for value in values)]
    text = f"{mark}{name}: {flow(values)}"
    if len(text) + len(comment) + 2 > WIDTH:
        return [f"{indent}{comment}", text]
    return [f"{text:34}  {comment}"]
