"""The settings of all rooms in one tree: defaults, files, overrides, and the commented file."""

import difflib
import math
import textwrap
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field

from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.errors import SettingsError, refusal
from sphereorient.files.yaml_file import flow, parse_override, read_yaml, validated
from sphereorient.follow.settings import RefineSettings
from sphereorient.locate.settings import LocateSettings
from sphereorient.mapping.settings import MapSettings
from sphereorient.motion.settings import MotionSettings, SmoothSettings
from sphereorient.search.settings import GreySearchSettings, OrientSettings, ProposeSettings
from sphereorient.statistics.settings import StatisticsSettings

Model = TypeVar("Model", bound=BaseModel)
DEFAULT_METHOD = "precise"


def _branch(model: type[Model], what: str, *methods: str) -> Any:
    """Return the field of a branch and the `methods` that read it, except keys that name their own."""
    return Field(default_factory=model, description=what, json_schema_extra={"methods": list(methods)})


class Settings(BaseModel, frozen=True, extra="forbid"):
    """All settings, one branch a stage."""

    locate: LocateSettings = _branch(LocateSettings, "location of the sphere (both methods)", "precise", "paper", "map")
    propose: ProposeSettings = _branch(ProposeSettings, "proposals of orientations (both methods)", "precise", "paper")
    search: GreySearchSettings = _branch(GreySearchSettings, "search without history (precise)", "precise")
    refine: RefineSettings = _branch(RefineSettings, "fit of the poses (precise)", "precise")
    path: PathSettings = _branch(PathSettings, "choice among candidates (precise)", "precise")
    smooth: SmoothSettings = _branch(SmoothSettings, "smoother (precise)", "precise")
    orient: OrientSettings = _branch(OrientSettings, "search without history (paper)", "paper")
    assemble: AssembleSettings = _branch(AssembleSettings, "choice among candidates (paper)", "paper")
    motion: MotionSettings = _branch(MotionSettings, "velocities, accelerations (paper)", "paper")
    paint: MapSettings = _branch(MapSettings, "texture map from movies (`map`)", "map")
    statistics: StatisticsSettings = _branch(StatisticsSettings, "numbers of a report", "report")


def _methods(model: type[BaseModel], name: str) -> Any:
    """Return the methods that a field names as its readers, or None."""
    extra = model.model_fields[name].json_schema_extra
    return extra.get("methods") if isinstance(extra, dict) else None


def _values(settings: Settings) -> dict[str, Any]:
    """Return the values by key `branch.name`."""
    return {f"{branch}.{name}": value for branch, part in settings for name, value in part}


DEFAULTS = _values(Settings())
# The methods that read each key `branch.name`: its own, or its branch's.
READERS: dict[str, list[str]] = {
    f"{branch}.{name}": _methods(type(part), name) or _methods(Settings, branch)
    for branch, part in Settings()
    for name in type(part).model_fields
}
METHODS = tuple(dict.fromkeys(method for methods in READERS.values() for method in methods))


def load_settings(path: Path | None = None, overrides: Iterable[str] = (), method: str | None = None) -> Settings:
    """Read settings from a file and single overrides, as `read_settings`; its remarks become warnings."""
    settings, remarks = read_settings(path, overrides, method)
    for remark in remarks:
        warnings.warn(remark, stacklevel=2)
    return settings


def read_settings(
    path: Path | None = None, overrides: Iterable[str] = (), method: str | None = None
) -> tuple[Settings, list[str]]:
    """Read settings from a file and single overrides; return also remarks for the user.

    Args:
        path: YAML as `sphereorient settings` writes it; missing keys keep their defaults. None: all defaults.
        overrides: texts `room.key=value`, value in YAML; later ones win.
        method: refuse keys that this method does not read; None: accept all keys.

    Raises SettingsError: no such file, an unknown key, an impossible value, or a key that the method does not read (in
    a file: with another value than the default).
    """
    remarks: list[str] = []
    overrides = ["=".join(part.strip() for part in text.split("=", 1)) for text in overrides]
    for text in overrides if method is not None else ():
        key = text.partition("=")[0]
        if key in DEFAULTS and not is_read(key, str(method)):
            raise SettingsError(_not_read(f"--set {key}", key, str(method)))
    tree = _read(path)
    settings = read_model(Settings, path, overrides)
    if method is not None and path is not None:
        check_settings(settings, method, str(path))
        given = [(branch, f"{branch}.{name}") for branch, part in tree.items() for name in part]
        of_method = {key.partition(".")[0] for key in READERS if is_read(key, method)}
        aside = sorted({key if branch in of_method else branch for branch, key in given if not is_read(key, method)})
        if aside:
            remarks.append(f"{path}: method {method} does not read {', '.join(aside)}: ignored")
    return settings, remarks


def is_read(key: str, method: str) -> bool:
    """Return whether a method reads the key `branch.name`."""
    return method in READERS.get(key, ())


def check_settings(settings: Settings, method: str, source: str = "settings") -> None:
    """Raise SettingsError if a key that the method does not read differs from its default."""
    for key, value in _values(settings).items():
        if value != DEFAULTS[key] and not is_read(key, method):
            raise SettingsError(_not_read(f"{source}, {key}", key, method))


def _not_read(name: str, key: str, method: str) -> str:
    """Return the message for a key that a method does not read, with the nearest one that it reads."""
    known = {read.partition(".")[2]: read for read in reversed(DEFAULTS) if is_read(read, method)}
    leaf = key.partition(".")[2]
    unit = [name for name in known if name.rpartition("_")[2] == leaf.rpartition("_")[2]]
    near = [name for some in (unit, list(known)) for name in difflib.get_close_matches(leaf, some, 1, 0.6)]
    others = READERS[key]
    instead = f"use {known[near[0]]}, " if near else ""
    do = f"leave it out, {instead}or use it with {' or '.join(others)}"
    return refusal(name, expected=f"a key that method {method} reads", got=f"one of {' and '.join(others)}", do=do)


def read_model(model: type[Model], path: Path | None = None, overrides: Iterable[str] = (), **changes: Any) -> Model:
    """Read the settings of a model from a file, changed by key, and by overrides; arguments as `read_settings`."""
    source, tree = str(path) if path else "settings", _read(path) | changes
    for text in overrides:
        _override(tree, text, _depths(model))
    settings = validated(model, tree, source, SettingsError)
    if key := _not_finite(settings.model_dump()):
        do = "correct the value"
        raise SettingsError(refusal(f"{source}, {key}", expected="a finite number", got="another", do=do))
    return settings


def _not_finite(value: Any) -> str:
    """Return the key of an infinite or NaN number; "" if all are finite."""
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


def _depths(model: Any) -> set[int]:
    """Return the depths of a model's keys: room.key has two."""
    fields = model.model_fields.values() if isinstance(model, type) and issubclass(model, BaseModel) else ()
    return {1 + depth for field in fields for depth in _depths(field.annotation)} or {0}


def _override(tree: dict[str, Any], text: str, depths: set[int]) -> None:
    """Put `key=value` into a tree; with rooms the key begins with its room."""
    key, value = parse_override(text)
    *rooms, leaf = key.split(".")
    if len(rooms) + 1 not in depths:
        expected = "key=value" if depths == {1} else "room.key=value"
        do = "give one key and its value"
        raise SettingsError(refusal(f"--set {text}", expected=expected, got=repr(text), do=do))
    for room in rooms:
        branch = tree.setdefault(room, {})
        tree = branch if isinstance(branch, dict) else {}
    tree[leaf] = value


def settings_yaml(settings: Settings | None = None, method: str | None = None) -> str:
    """Write settings (of a method: the keys that it reads) as YAML, each key below its description as a comment."""
    of = f", method {method}" if method else ""
    return model_yaml(f"Settings of sphereorient{of}", settings or Settings(), method)


def model_yaml(title: str, settings: BaseModel, method: str | None = None) -> str:
    """Write the settings of a model, with or without rooms, as `settings_yaml`."""
    flat, also = 1 in _depths(type(settings)), " --set room.key=value overrides one."
    lines = [f"# {title}; any key may be left out.{'' if flat else also}", ""]
    if flat:
        return "\n".join([*lines, *_commented(settings, ""), ""])
    for room, field in type(settings).model_fields.items():
        branch = getattr(settings, room)
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
        elif len(indent + key + flow(value)) > 110 and isinstance(value, tuple):
            lines += [f"{indent}{key}:", *(f"{indent}  - {flow(item)}" for item in value)]
        else:
            lines.append(f"{indent}{key}: {flow(value)}")
    return lines
