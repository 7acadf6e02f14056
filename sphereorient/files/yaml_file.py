"""Reading and writing bounded YAML files of plain values; every fault is one line with file and key. Drafts for users:
each key with a comment, unknown ones left open.
"""

import difflib
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from yaml.composer import ComposerError
from yaml.parser import ParserError
from yaml.scanner import ScannerError

from sphereorient.errors import SettingsError, SphereOrientError, refusal
from sphereorient.files.whole_file import MARK, TEXT_BYTES, read_text, sealed, write_text

Model = TypeVar("Model", bound=BaseModel)
SHOWN = 20  # known names in a message
MAX_DEPTH = 30  # the files have five levels
MAX_NODES = 20_000  # aliases count at each use; a covariance of 100 parameters has 10,000
MAX_TEXT = 4096  # characters of one value, such as a path
MAX_NUMBER = 64  # characters of a number; longer ones convert slowly and fill messages
MAX_KEY = 100  # characters of a key, which appears in messages
NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
# Control characters, lone surrogates and line separators break messages of one line.
UNSEEN = frozenset({"Cc", "Cs", "Zl", "Zp"})
FAULTS = (yaml.YAMLError, ValueError, OverflowError)  # an impossible date is a ValueError, 1:1:...:1.5 an OverflowError
WIDTH = 120  # characters of a line
SLIP_LINES = 2  # searched for a slip before the line at which the parser stops
SLIPS = {  # in a line of YAML without its comment
    "a tab, where spaces belong,": re.compile(r"^\s*\t|:\s*\t"),
    "a quote that is not closed": re.compile(r"""[:\[{,-]\s*(["'])(?:(?!\1).)*$"""),
    "no space after the colon": re.compile(r"^\s*(?:- )?[\w.]+:[^\s/\\]"),
    "a text with a colon, which needs quotes,": re.compile(r"^\s*(?:- )?[\w.]+: [^\"'{\[]*: "),
}


def read_document(
    path: Path, schema: str, error: type[SphereOrientError], do: str = "correct the path"
) -> dict[str, Any]:
    """Read a YAML mapping of this `schema`, without that key; raise `error` for others; `do`: for a missing file."""
    document = read_yaml(path, error, do)
    if not isinstance(document, dict):
        got = "an empty file" if document is None else short(document)
        raise error(refusal(str(path), expected="keys and values", got=got, do=f"begin with 'schema: {schema}'"))
    found = document.pop("schema", None)
    if found != schema:
        got, do = "none" if found is None else short(found), f"name a {schema.partition('/')[0]} file of this version"
        raise error(refusal(f"{path}, schema", expected=schema, got=got, do=do))
    return document


def read_yaml(path: Path, error: type[SphereOrientError], do: str = "correct the path") -> Any:
    """Read a YAML file of plain values, UTF-8, at most TEXT_BYTES; None if empty; raise `error` for anything else."""
    text = read_text(path, TEXT_BYTES, "a YAML file", error, do)
    try:
        return parse_yaml(text)
    except FAULTS as fault:
        raise error(refusal(str(path), expected="YAML", got=yaml_words(fault), do="correct the file there")) from fault


def validated(
    model: type[Model], data: Any, where: str, error: type[SphereOrientError], also: Sequence[str] = ()
) -> Model:
    """Validate YAML data against a model that forbids extra keys; raise `error` with the first fault and `where`.
    All missing keys are named together with `also`, missing keys found by the caller.
    """
    try:
        return model.model_validate(data)
    except ValidationError as fault:
        raise error(_worded(fault, model, where, also)) from None


def refuse_unknown(key: object, known: Iterable[str], where: str) -> str:
    """Word the refusal of an unknown key or name, with the nearest known one."""
    names = [str(name) for name in known]
    shown = names if len(names) <= SHOWN else [*names[:SHOWN], "..."]
    near = difflib.get_close_matches(str(key), names, n=1, cutoff=0.5)
    do = f"write '{near[0]}' instead" if near else "remove it"
    return refusal(where, expected=f"one of {', '.join(shown)}", got=short(str(key)), do=do)


def write_document(path: Path, schema: str, document: Mapping[str, Any], comment: str = "") -> None:
    """Write YAML with its schema as first key, the mark and `comment` above, replacing an old file atomically.
    Small numbers are written as 1.0e-05, since YAML 1.1 reads 1e-05 as text.
    """
    comment = comment if MARK in comment.partition("\n")[0] else f"{MARK}\n{comment}"
    lines = "".join(f"# {line}\n" for line in comment.splitlines())
    content = {"schema": schema, **document}
    text = lines + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)
    write_text(path, text)


def short(value: object) -> str:
    """Return a value as one line of at most 60 characters, for a message."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def flow(value: Any) -> str:
    """Return a value as YAML in one line, without aliases."""
    how: dict[str, Any] = {"default_flow_style": True, "sort_keys": False, "width": 1 << 20, "allow_unicode": True}
    text: str = yaml.dump(value, Dumper=_PlainDumper, **how)
    return text.strip().removesuffix("...").strip()


def parse_override(text: str) -> tuple[str, Any]:
    """Return key and value (YAML) of `key=value`, the text of an option --set; SettingsError for other texts."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise SettingsError(refusal(f"--set {text}", expected="key=value", got=short(text), do="give both"))
    try:
        return key.strip(), parse_yaml(value)
    except FAULTS:
        do = "quote it for the shell"
        raise SettingsError(refusal(f"--set {text}", expected="a YAML value", got=short(value), do=do)) from None


def yaml_words(fault: Exception) -> str:
    """Return the fault of a YAML text in one short line: the likely slip, else the parser's message."""
    mark = getattr(fault, "problem_mark", None)
    if isinstance(fault, ScannerError | ParserError) and (slip := _slip(fault)):
        return slip
    problem = " ".join((getattr(fault, "problem", None) or str(fault).partition("\n")[0]).split())
    problem = problem if len(problem) <= 120 else problem[:117] + "..."
    return f"'{problem}'" + (f" in line {mark.line + 1}" if mark else "")


def _slip(fault: ScannerError | ParserError) -> str | None:
    """Return the likely slip behind a fault of a YAML text, with its line; None if unknown."""
    at, begun = fault.problem_mark, fault.context_mark
    if at is None or not at.buffer:
        return None
    lines = [line.partition(" #")[0] for line in at.buffer.rstrip("\0").split("\n")]
    for number in range(min(at.line, len(lines) - 1), max(at.line - SLIP_LINES, 0) - 1, -1):
        slip = next((words for words, pattern in SLIPS.items() if pattern.search(lines[number])), None)
        if slip:
            return f"{slip} in line {number + 1}"
    if begun is not None and "flow" in (fault.context or ""):
        return f"a bracket that is not closed, or a comma that is missing, in the part from line {begun.line + 1}"
    if "block" in (fault.context or "") or "mapping values" in (fault.problem or ""):
        return f"an indent unlike any line above in line {at.line + 1}"
    return None


def parse_yaml(text: str, most_nodes: int = MAX_NODES) -> Any:
    """Parse one bounded YAML document of plain values; aliases are allowed, tags and repeated keys are not. Raises
    yaml.YAMLError: not YAML, or with tags, repeated keys, keys that are not names, or beyond a bound above; ValueError:
    an impossible value, such as an impossible date; OverflowError: too large a number to the base 60.
    """
    return _BoundedLoader(text, most_nodes).get_single_data()


def with_value(text: str, place: Sequence[str | int], value: Any) -> str | None:
    """Return a YAML text with the value at `place` (keys and numbers of list entries) replaced in one line; the rest
    stays, with comments. An absent last key is added, in the place of a commented-out one. None if something could be
    lost: an old value in several lines, or an unknown form.
    """
    *above, key = place
    try:
        wanted = _changed(parse_yaml(text), place, value)
        new = _spliced(text, _node_at(_BoundedLoader(text).get_single_node(), above), str(key), flow(value))
        return new if new is not None and parse_yaml(new) == wanted else None
    except (*FAULTS, LookupError, TypeError):
        return None


def _changed(data: Any, place: Sequence[str | int], value: Any) -> Any:
    step, *rest = place
    new: Any = list(data) if isinstance(data, list) else dict(data)
    new[step] = _changed(data[step], rest, value) if rest else value
    return new


def _node_at(node: yaml.Node | None, place: Iterable[str | int]) -> yaml.Node:
    for step in place:
        if isinstance(node, yaml.SequenceNode):
            node = node.value[int(step)]
        elif isinstance(node, yaml.MappingNode):
            node = next((value for name, value in node.value if name.value == step), None)
    if node is None:
        raise LookupError(place)
    return node


def _spliced(text: str, node: yaml.Node, key: str, line: str) -> str | None:
    """Return a text whose mapping `node` has a key with this line as value; None if the old value has more lines."""
    if not isinstance(node, yaml.MappingNode) or not node.value:
        return None
    for name, old in node.value:
        if name.value == key:
            start, end = old.start_mark, old.end_mark
            one_line = start.line == end.line and (isinstance(old, yaml.ScalarNode) or old.flow_style)
            return text[: start.index] + line + text[end.index :] if one_line else None
    last = node.value[-1][1]
    if node.flow_style:
        return f"{text[: last.end_mark.index]}, {key}: {line}{text[last.end_mark.index :]}"
    indent = " " * node.start_mark.column
    commented = re.compile(rf"^{indent}# ?{re.escape(key)}:.*$", re.MULTILINE)
    if not indent and commented.search(text):
        return commented.sub(lambda _: f"{key}: {line}", text, count=1)
    while isinstance(last, yaml.CollectionNode) and not last.flow_style:  # the end of a block is not exact
        last = last.value[-1] if isinstance(last, yaml.SequenceNode) else last.value[-1][1]
    end = last.end_mark.index
    end += len(text[end:].partition("\n")[0].rstrip("\r"))
    rest = text[end:] or "\n"
    return f"{text[:end]}\n{indent}{key}: {line}{rest}"


class _PlainDumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader with bounds, checked before any value is built; an alias counts with its size."""

    def __init__(self, text: str, most_nodes: int = MAX_NODES) -> None:
        super().__init__(text)
        self._most = most_nodes
        self._depth = 0
        self._nodes = 0
        self._size: dict[yaml.Node, int] = {}  # number of nodes in each finished node, with itself

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event, before = self._next(), self._nodes
        self._depth, self._nodes = self._depth + 1, self._nodes + 1
        self._check(self._depth <= MAX_DEPTH, f"more than {MAX_DEPTH} levels", event)
        self._check(getattr(event, "tag", None) in (None, "!"), "a tag, which is not used here", event)
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            self._check(node in self._size, "a value that contains itself", event)
            self._nodes += self._size.get(node, 0) if node is not None else 0
        elif node is not None:
            self._size[node] = self._nodes - before
        self._check(self._nodes <= self._most, f"more than {self._most} values", event)
        self._depth -= 1
        return node

    def compose_scalar_node(self, anchor: Any) -> yaml.ScalarNode:
        event = self._next()
        node = super().compose_scalar_node(anchor)
        longest = MAX_NUMBER if node.tag in NUMBERS else MAX_TEXT
        self._check(len(node.value) <= longest, f"a value of more than {longest} characters", event)
        one_line = node.value.isprintable() or not any(unicodedata.category(letter) in UNSEEN for letter in node.value)
        self._check(one_line, "a text of several lines, or with control characters", event)
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            plain = isinstance(key, yaml.ScalarNode) and len(key.value) <= MAX_KEY
            self._check(plain, f"a key that is no name of at most {MAX_KEY} characters", key)
            self._check(key.value not in seen, f"the key '{key.value}' twice", key)
            seen.add(key.value)
        return node

    def _next(self) -> yaml.Event:
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        return event

    def _check(self, holds: bool, problem: str, at: Any) -> None:
        if not holds:
            raise ComposerError(None, None, problem, at.start_mark)


def _worded(fault: ValidationError, model: type[BaseModel], where: str, also: Sequence[str]) -> str:
    # An unknown key first, often a mistyped missing one.
    first = min(fault.errors(include_url=False), key=lambda error: error["type"] != "extra_forbidden")
    place, kind, message = first["loc"], first["type"], first["msg"]
    if isinstance(cause := first.get("ctx", {}).get("error"), SphereOrientError):  # already worded
        return f"{where}, {cause}"
    name = ", ".join([where, ".".join(map(str, place))]) if place else where
    if kind == "extra_forbidden":
        return refuse_unknown(place[-1], _known_keys(model, place[:-1]), ", ".join([where, *map(str, place[:-1])]))
    if kind == "missing":
        missing = [*also, *(".".join(map(str, one["loc"])) for one in fault.errors() if one["type"] == "missing")]
        if len(missing) > 1:
            return refusal(where, expected="all needed keys", got=f"no {', '.join(missing)}", do="add them")
        return refusal(name, expected="a value", got="none", do="add the key")
    expected = message.removeprefix("Value error, ").removeprefix("Input should be ")
    expected = expected[:1].lower() + expected[1:]
    return refusal(name, expected=expected, got=short(first["input"]), do="correct the value")


def _known_keys(model: type[BaseModel], place: Iterable[int | str]) -> list[str]:
    """Return the keys of the part of a model at the path `place`."""
    for step in place:
        if str(step) in model.model_fields:  # others are names or numbers in the file, such as of a camera
            annotation = model.model_fields[str(step)].annotation
            kinds = (annotation, *get_args(annotation))
            model = next(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel))
    return list(model.model_fields)


@dataclass(frozen=True, kw_only=True)
class DraftKey:
    """A key of a draft."""

    name: str  # with its parent: sphere.diameter
    value: Any = ...  # ...: unknown
    comment: str  # unit, meaning, measured value
    example: Any = None  # for an unknown value
    asked: bool = False  # whether the file needs it


def given(keys: Sequence[DraftKey], changes: Iterable[str]) -> list[DraftKey]:
    """Return keys with values `name=value`, YAML, filled in; SettingsError for an unknown name or invalid YAML."""
    known = {key.name: key for key in keys}
    for text in changes:
        name, found = parse_override(text)
        if name not in known:
            raise SettingsError(refuse_unknown(name, known, "--set"))
        key = known[name]
        example = key.example if key.value in (..., None) else key.value
        if found is not None and not _alike(found, example):
            expected = f"a value like {flow(example)[:60]}"
            raise SettingsError(refusal(f"--set {name}", expected=expected, got=short(found), do="write such a value"))
        known[key.name] = replace(key, value=found)
    return list(known.values())


def _alike(value: Any, example: Any) -> bool:
    """Return whether a value is of an example's kind: a number, text, boolean, or a list or mapping of these."""
    if isinstance(example, Mapping):
        some = next(iter(example.values()), None)
        return isinstance(value, Mapping) and all(_alike(part, example.get(name, some)) for name, part in value.items())
    if isinstance(example, list | tuple):
        return isinstance(value, list) and all(_alike(part, example[0]) for part in value)
    if isinstance(example, bool) or not isinstance(example, int | float):
        return example is None or isinstance(value, type(example))
    return isinstance(value, int | float) and not isinstance(value, bool)


def open_keys(keys: Iterable[DraftKey]) -> list[DraftKey]:
    """Return the needed keys of unknown value."""
    return [key for key in keys if key.asked and key.value is ...]


def draft_yaml(schema: str, keys: Sequence[DraftKey], head: str = "") -> str:
    """Return the text of a file: unknown keys are comments, with an example; needed ones are marked. Without its "#"
    each such line is a key in its place; lines that only explain begin with "##".
    """
    lines = [*(f"## {line}" for line in head.splitlines()), f"schema: {schema}", *_block(keys, ""), ""]
    return sealed("\n".join(lines))


def _block(keys: Sequence[DraftKey], indent: str) -> list[str]:
    """Return the lines of keys; a parent without known keys takes one line."""
    groups: dict[str, list[DraftKey]] = {}
    for key in keys:
        parent, _, name = key.name.partition(".")
        groups.setdefault(parent, []).append(replace(key, name=name))
    lines = list[str]()
    for parent, children in groups.items():
        first = children[0]
        if first.name and all(key.value is ... for key in children):
            first = replace(first, name="", example={key.name: key.example for key in children})
        lines += (
            [f"{indent}{parent}:", *_block(children, f"{indent}  ")] if first.name else _line(first, parent, indent)
        )
    return lines


def _line(key: DraftKey, name: str, indent: str) -> list[str]:
    known = key.value is not ...
    values = key.value if known else key.example
    comment = f"# {'' if known or not key.asked else 'WRITE THIS: '}{key.comment}" if key.comment else ""
    mark = indent if known else f"{indent}#"  # without the "#" the key is in its place
    if isinstance(values, list) and values and isinstance(values[0], Mapping):
        return [f"{mark}{name}:  {comment}", *(f"{mark}  - {flow(value)}" for value in values)]
    text = f"{mark}{name}: {flow(values)}"
    if len(text) + len(comment) + 2 > WIDTH:
        return [f"{indent}#{comment}", text] if comment else [text]
    return [f"{text:34}  {comment}".rstrip()]
