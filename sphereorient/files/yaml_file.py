"""Reading and writing the project's YAML files; every fault becomes one line that names the file and the key."""

from __future__ import annotations

import difflib
import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from sphereorient.errors import OutputError, SphereOrientError, refusal
from sphereorient.files.bounded_yaml import FAULTS, parse_yaml
from sphereorient.files.whole_file import TEXT_BYTES, read_whole

Model = TypeVar("Model", bound=BaseModel)
SHOWN = 20  # known names in a message


def read_document(path: Path, schema: str, error: type[SphereOrientError]) -> dict[str, Any]:
    """Read a YAML file that declares a schema.

    Args:
        path: the file.
        schema: what its key `schema` must say, such as sphereorient-cameras/1.
        error: the error to raise.

    Returns:
        The mapping without the key `schema`.

    Raises:
        error: missing, unreadable, not YAML, not a mapping, or of another schema.
    """
    document = read_yaml(path, error)
    if not isinstance(document, dict):
        got = "an empty file" if document is None else short(document)
        raise error(refusal(str(path), expected="keys and values", got=got, do=f"begin with 'schema: {schema}'"))
    found = document.pop("schema", None)
    if found != schema:
        got, do = "none" if found is None else short(found), f"name a {schema.partition('/')[0]} file of this version"
        raise error(refusal(f"{path}, schema", expected=schema, got=got, do=do))
    return document


def read_yaml(path: Path, error: type[SphereOrientError]) -> Any:
    """Read a YAML file of plain values, whoever wrote it.

    Args:
        path: the file, UTF-8, at most TEXT_BYTES.
        error: the error to raise.

    Returns:
        What it says; None where it is empty.

    Raises:
        error: missing, unreadable, no text, or no YAML that `parse_yaml` takes.
    """
    content = read_whole(path, TEXT_BYTES, "a YAML file", error, "correct the path")
    try:
        return parse_yaml(content.decode("utf-8-sig"))  # editors of some systems put a mark in front
    except UnicodeDecodeError:
        got, do = "bytes that are no text", "save it as UTF-8"
        raise error(refusal(str(path), expected="a YAML file", got=got, do=do)) from None
    except FAULTS as fault:
        raise error(refusal(str(path), expected="YAML", got=yaml_words(fault), do="correct the file there")) from fault


def validated(model: type[Model], data: Any, where: str, error: type[SphereOrientError]) -> Model:
    """Check data from a YAML file against a model, and word its first fault in one line.

    Args:
        model: which keys there are and what they hold; it must forbid extra keys.
        data: what the file says.
        where: file, and place in it, for the message.
        error: the error to raise.

    Raises:
        error: an unknown key (with the nearest known one), a missing key, or an impossible value.
    """
    try:
        return model.model_validate(data)
    except ValidationError as fault:
        raise error(_worded(fault, model, where)) from None


def refuse_unknown(key: object, known: Iterable[str], where: str) -> str:
    """Word the refusal of a key or name that is not known, with the nearest one that is."""
    names = [str(name) for name in known]
    shown = names if len(names) <= SHOWN else [*names[:SHOWN], "..."]
    near = difflib.get_close_matches(str(key), names, n=1, cutoff=0.5)
    do = f"write '{near[0]}' instead" if near else "remove it"
    return refusal(where, expected=f"one of {', '.join(shown)}", got=short(str(key)), do=do)


def write_document(path: Path, schema: str, document: Mapping[str, Any], comment: str = "") -> None:
    """Write a YAML file aside and put it in place at once, so that no half file is ever seen.

    Args:
        path: the file; an old one is replaced.
        schema: value of its first key.
        document: plain mappings, lists, texts and numbers. Small numbers come out as 1.0e-05, which YAML 1.1 reads
            as numbers (1e-05 it takes for text).
        comment: lines for the top of the file.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = "".join(f"# {line}\n" for line in comment.splitlines())
    content = {"schema": schema, **document}
    text = lines + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)
    aside = None
    try:
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=path.parent, delete=False) as file:
            aside = Path(file.name)
            file.write(text)
        aside.chmod(0o666 & ~_umask())  # temporary files are private; a result is not
        aside.replace(path)
    except OSError as fault:
        if aside is not None:
            aside.unlink(missing_ok=True)
        do = "choose a folder that exists and may be written"
        raise OutputError(
            refusal(str(path), expected="a file that can be written", got=f"'{fault.strerror}'", do=do)
        ) from fault


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _worded(fault: ValidationError, model: type[BaseModel], where: str) -> str:
    # An unknown key first: it is often a missing one, mistyped.
    first = min(fault.errors(include_url=False), key=lambda error: error["type"] != "extra_forbidden")
    place, kind, message = first["loc"], first["type"], first["msg"]
    name = ", ".join([where, ".".join(map(str, place))]) if place else where
    if kind == "extra_forbidden":
        return refuse_unknown(place[-1], _keys(model, place[:-1]), ", ".join([where, *map(str, place[:-1])]))
    if kind == "missing":
        return refusal(name, expected="a value", got="none", do="add the key")
    expected = message.removeprefix("Value error, ").removeprefix("Input should be ")
    expected = expected[:1].lower() + expected[1:]
    return refusal(name, expected=expected, got=short(first["input"]), do="correct the value")


def _keys(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the model that stands at a place inside another."""
    for step in place:
        if str(step) not in model.model_fields:  # a name or a number that the file gives, such as a camera's
            continue
        annotation = model.model_fields[str(step)].annotation
        inner = [kind for kind in (annotation, *get_args(annotation)) if _is_model(kind)]
        model = inner[0]
    return list(model.model_fields)


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def short(value: object) -> str:
    """Return a value as one line of at most 60 characters, for a message."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def yaml_words(fault: Exception) -> str:
    """Word what is wrong with a YAML text in one short line."""
    mark = getattr(fault, "problem_mark", None)
    problem = " ".join((getattr(fault, "problem", None) or str(fault).partition("\n")[0]).split())
    problem = problem if len(problem) <= 120 else problem[:117] + "..."
    return f"'{problem}'" + (f" in line {mark.line + 1}" if mark else "")
