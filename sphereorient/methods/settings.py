"""The settings of all rooms in one tree: defaults, files, single overrides, and the commented file."""

import difflib
import math
import textwrap
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, Field, ValidationError

from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.errors import SettingsError, refusal
from sphereorient.files.yaml_file import FAULTS, known_keys, parse_yaml, read_yaml, short
from sphereorient.follow.settings import RefineSettings
from sphereorient.learn.settings import ProposerSettings
from sphereorient.locate.settings import LocateSettings
from sphereorient.mapping.settings import MapSettings
from sphereorient.motion.settings import MotionSettings, SmoothSettings
from sphereorient.search.settings import GreySearchSettings, OrientSettings, ProposeSettings
from sphereorient.statistics.settings import StatisticsSettings
from sphereorient.synth.settings import SynthSettings

Model = TypeVar("Model", bound=BaseModel)
DEFAULT_METHOD = "precise"


def _branch(model: type[Model], what: str, *methods: str) -> Any:
    """Return the field of a branch with the `methods` that read it, but for keys that name theirs."""
    return Field(default_factory=model, description=what, json_schema_extra={"methods": list(methods)})


class Settings(BaseModel, frozen=True, extra="forbid"):
    """All settings, one branch a stage."""

    locate: LocateSettings = _branch(LocateSettings, "where is the sphere (both methods)", "precise", "paper", "map")
    propose: ProposeSettings = _branch(ProposeSettings, "who proposes orientations (both methods)", "precise", "paper")
    search: GreySearchSettings = _branch(GreySearchSettings, "where could it point (precise)", "precise")
    refine: RefineSettings = _branch(RefineSettings, "poses to hundredths (precise)", "precise")
    path: PathSettings = _branch(PathSettings, "which candidate is true (precise)", "precise")
    smooth: SmoothSettings = _branch(SmoothSettings, "motion from the track (precise)", "precise")
    orient: OrientSettings = _branch(OrientSettings, "where could it point (paper)", "paper")
    assemble: AssembleSettings = _branch(AssembleSettings, "which candidate is true (paper)", "paper")
    motion: MotionSettings = _branch(MotionSettings, "velocities, accelerations (paper)", "paper")
    paint: MapSettings = _branch(MapSettings, "the map from the movies (`map`)", "map")
    statistics: StatisticsSettings = _branch(StatisticsSettings, "numbers of a report", "report")


def _methods(model: type[BaseModel], name: str) -> Any:
    """Return the methods that a field names as its readers; None: it names none."""
    extra = model.model_fields[name].json_schema_extra
    return extra.get("methods") if isinstance(extra, dict) else None


def _values(settings: Settings) -> dict[str, Any]:
    """Return the values by key `branch.name`."""
    return {f"{branch}.{name}": value for branch, part in settings for name, value in part}


DEFAULTS = _values(Settings())
# The methods that read each key `branch.name`: those that it names itself, or its branch's.
READERS: dict[str, list[str]] = {
    f"{branch}.{name}": _methods(type(part), name) or _methods(Settings, branch)
    for branch, part in Settings()
    for name in type(part).model_fields
}
METHODS = tuple(dict.fromkeys(method for methods in READERS.values() for method in methods))
# Numbers of dotted names in a key.
DEPTHS: dict[type[BaseModel], tuple[int, ...]] = {Settings: (2,), SynthSettings: (1,), ProposerSettings: (2, 3)}


@dataclass(frozen=True)
class Loaded:
    """Settings as read, and remarks for the user."""

    settings: Settings
    remarks: tuple[str, ...]


def load_settings(path: Path | None = None, overrides: Iterable[str] = (), method: str | None = None) -> Settings:
    """Read settings from a file and single overrides, as `read_settings`; its remarks become warnings."""
    loaded = read_settings(path, overrides, method)
    for remark in loaded.remarks:
        warnings.warn(remark, stacklevel=2)
    return loaded.settings


def read_settings(path: Path | None = None, overrides: Iterable[str] = (), method: str | None = None) -> Loaded:
    """Read settings from a file and single overrides.

    Args:
        path: YAML as `sphereorient settings` writes it; missing keys keep their defaults. None: all defaults.
        overrides: texts `room.key=value`, value in YAML; later ones win.
        method: refuse keys that this method does not read; None: accept all keys.

    Raises:
        SettingsError: no such file, an unknown key, an impossible value, or a key that the method does not read (in a
            file: with another value than the default).
    """
    remarks: list[str] = []
    overrides = ["=".join(part.strip() for part in text.split("=", 1)) for text in overrides]
    for text in overrides if method is not None else ():
        key = text.partition("=")[0]
        if key in DEFAULTS and not is_read(key, str(method)):
            raise SettingsError(_not_read(f"--set {key}", key, str(method)))
    tree = _read(path)
    settings = _load(Settings, tree, path, overrides)
    if method is not None and path is not None:
        check_settings(settings, method, str(path))
        given = [(branch, f"{branch}.{name}") for branch, part in tree.items() for name in part]
        of_method = {key.partition(".")[0] for key in READERS if is_read(key, method)}
        aside = sorted({key if branch in of_method else branch for branch, key in given if not is_read(key, method)})
        if aside:
            remarks.append(f"{path}: method {method} does not read {', '.join(aside)}: left aside")
    return Loaded(settings, tuple(remarks))


def is_read(key: str, method: str) -> bool:
    """Return whether a method reads the key `branch.name`."""
    return method in READERS.get(key, ())


def check_settings(settings: Settings, method: str, source: str = "settings") -> None:
    """Raise SettingsError if a key that the method does not read differs from its default."""
    for key, value in _values(settings).items():
        if value != DEFAULTS[key] and not is_read(key, method):
            raise SettingsError(_not_read(f"{source}, {key}", key, method))


def _not_read(name: str, key: str, method: str) -> str:
    """Return the message about a key that a method does not read, with the nearest one that it reads."""
    known = {read.partition(".")[2]: read for read in reversed(DEFAULTS) if is_read(read, method)}
    leaf = key.partition(".")[2]
    unit = [name for name in known if name.rpartition("_")[2] == leaf.rpartition("_")[2]]
    near = [name for some in (unit, list(known)) for name in difflib.get_close_matches(leaf, some, 1, 0.6)]
    others = READERS[key]
    instead = f"use {known[near[0]]}, " if near else ""
    do = f"leave it out, {instead}or use it with {' or '.join(others)}"
    return refusal(name, expected=f"a key that method {method} reads", got=f"one of {' and '.join(others)}", do=do)


def read_flat(model: type[Model], path: Path | None, changes: Mapping[str, Any]) -> Model:
    """Read settings without branches from a file, and change some; as `load_settings`."""
    return _load(model, {**_read(path), **changes}, path, ())


def load_synth_settings(path: Path | None = None, overrides: Iterable[str] = ()) -> SynthSettings:
    """Read the settings of a synthetic experiment from a file and from overrides `key=value`; as `load_settings`."""
    return _load(SynthSettings, _read(path), path, overrides)


def load_proposer_settings(path: Path | None = None, overrides: Iterable[str] = ()) -> ProposerSettings:
    """Read the settings of a proposer's training from a file and from overrides; as `load_settings`."""
    return _load(ProposerSettings, _read(path), path, overrides)


def _load(model: type[Model], tree: dict[str, Any], path: Path | None, overrides: Iterable[str]) -> Model:
    source = str(path) if path else "settings"
    for text in overrides:
        _override(tree, text, DEPTHS[model])
    try:
        settings = model.model_validate(tree)
    except ValidationError as error:
        raise SettingsError(_explain(error, source, model)) from None
    if key := _not_finite(settings.model_dump()):
        do = "correct the value"
        raise SettingsError(refusal(f"{source}, {key}", expected="a finite number", got="another", do=do))
    return settings


def _not_finite(value: Any) -> str:
    """Return the key of a number that is infinite or NaN; "" if all are finite."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, tuple | list) else ()
    for key, inner in items:
        if isinstance(inner, float) and not math.isfinite(inner):
            return str(key)
        if below := _not_finite(inner):
            return f"{key}.{below}"
    return ""


def _read(path: Path | None) -> dict[str, Any]:
    tree = None if path is None else read_yaml(path, SettingsError)
    if not isinstance(tree, dict | None):
        got, do = type(tree).__name__, "see `sphereorient settings`"
        raise SettingsError(refusal(f"settings {path}", expected="keys and values", got=got, do=do))
    return tree or {}


def _override(tree: dict[str, Any], text: str, depths: tuple[int, ...]) -> None:
    """Put `key=value` into a tree; the key begins with its room if there are rooms."""
    key, equals, value = text.partition("=")
    *rooms, leaf = key.strip().split(".")
    if not equals or len(rooms) + 1 not in depths:
        expected = "key=value" if depths == (1,) else "room.key=value"
        do = "give one key and its value"
        raise SettingsError(refusal(f"--set {text}", expected=expected, got=repr(text), do=do))
    for room in rooms:
        branch = tree.setdefault(room, {})
        tree = branch if isinstance(branch, dict) else {}
    try:
        tree[leaf] = parse_yaml(value)
    except FAULTS:
        do = "quote it for the shell"
        raise SettingsError(refusal(f"--set {text}", expected="a YAML value", got=short(value), do=do)) from None


def _explain(error: ValidationError, source: str, model: type[BaseModel]) -> str:
    """Return pydantic's first error in one line."""
    first = error.errors()[0]
    if isinstance(refused := first.get("ctx", {}).get("error"), SettingsError):  # a room has worded it already
        return f"{source}, {refused}"
    parts = [str(part) for part in first["loc"]]
    key = ".".join(parts)
    if first["type"] == "extra_forbidden":
        known = known_keys(model, parts[:-1])
        near = difflib.get_close_matches(parts[-1], known, 1)
        do = f"did you mean {'.'.join([*parts[:-1], near[0]])}" if near else f"use one of {', '.join(known)}"
        return refusal(f"{source}, {key}", expected="a known key", got="an unknown one", do=do)
    expected = first["msg"].replace("Input should be ", "")
    return refusal(f"{source}, {key}", expected=expected, got=short(first["input"]), do="correct the value")


def settings_yaml(settings: Settings | None = None, method: str | None = None) -> str:
    """Write settings, of a method the keys that it reads, as YAML with each key's description as a comment above it."""
    of = f", method {method}" if method else ""
    head = f"# Settings of sphereorient{of}; any key may be left out. --set room.key=value overrides one."
    return _tree_yaml(head, settings or Settings(), method)


def flat_settings_yaml(head: str, settings: BaseModel) -> str:
    """Write settings without branches, those of `synth` and `bench robustness`, as commented YAML."""
    return "\n".join([f"# {head}; any key may be left out.", "", *_commented(settings, ""), ""])


def proposer_settings_yaml(settings: ProposerSettings | None = None) -> str:
    """Write the settings of a proposer's training as commented YAML."""
    head = "# Training of a proposer; any key may be left out. --set room.key=value overrides one."
    return _tree_yaml(head, settings or ProposerSettings())


def _tree_yaml(head: str, tree: BaseModel, method: str | None = None) -> str:
    lines = [head, ""]
    for room, field in type(tree).model_fields.items():
        branch = getattr(tree, room)
        left_out = [key for key in type(branch).model_fields if method and not is_read(f"{room}.{key}", method)]
        if len(left_out) < len(type(branch).model_fields):
            lines += [f"{room}:  # {field.description}", *_commented(branch, "  ", left_out), ""]
    return "\n".join(lines)


def _commented(branch: BaseModel, indent: str, left_out: Iterable[str] = ()) -> list[str]:
    lines = []
    for key, field in type(branch).model_fields.items():
        if key in left_out:
            continue
        value = getattr(branch, key)
        lines += [f"{indent}# {line}" for line in textwrap.wrap(field.description or "", 110)]
        if isinstance(value, BaseModel):
            lines += [f"{indent}{key}:", *_commented(value, indent + "  ")]
            continue
        shown = _scalar(value)
        if len(indent + key + shown) > 110 and isinstance(value, tuple):
            lines += [f"{indent}{key}:", *(f"{indent}  - {_scalar(item)}" for item in value)]
        else:
            lines.append(f"{indent}{key}: {shown}")
    return lines


def _scalar(value: Any) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_scalar(item) for item in value) + "]"
    text: str = yaml.safe_dump(value, default_flow_style=True).strip()
    return text.removesuffix("...").strip()
