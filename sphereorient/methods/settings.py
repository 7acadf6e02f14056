"""The settings of all rooms in one tree: defaults, files, single overrides, and the commented file."""

from __future__ import annotations

import difflib
import math
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.errors import SettingsError, refusal
from sphereorient.files.bounded_yaml import FAULTS, parse_yaml
from sphereorient.files.yaml_file import read_yaml, short
from sphereorient.learn.settings import ProposerSettings
from sphereorient.locate.settings import LocateSettings
from sphereorient.mapping.settings import MapSettings
from sphereorient.motion.settings import MotionSettings, SmoothSettings
from sphereorient.search.settings import GreySearchSettings, OrientSettings, ProposeSettings, RefineSettings
from sphereorient.statistics.settings import StatisticsSettings
from sphereorient.synth.settings import SynthSettings

Model = TypeVar("Model", bound=BaseModel)
METHODS = ("precise", "paper")
DEFAULT_METHOD = "precise"


class Settings(BaseModel):
    """All settings, one branch a stage; those of stages that a method does not have are not read by it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    locate: LocateSettings = Field(default_factory=LocateSettings, description="where is the sphere (both methods)")
    propose: ProposeSettings = Field(
        default_factory=ProposeSettings, description="who proposes orientations (both methods)"
    )
    search: GreySearchSettings = Field(default_factory=GreySearchSettings, description="where could it point (precise)")
    refine: RefineSettings = Field(default_factory=RefineSettings, description="poses to hundredths (precise)")
    path: PathSettings = Field(default_factory=PathSettings, description="which candidate is true (precise)")
    smooth: SmoothSettings = Field(default_factory=SmoothSettings, description="motion from the track (precise)")
    orient: OrientSettings = Field(default_factory=OrientSettings, description="where could it point (paper)")
    assemble: AssembleSettings = Field(default_factory=AssembleSettings, description="which candidate is true (paper)")
    motion: MotionSettings = Field(default_factory=MotionSettings, description="velocities, accelerations (paper)")
    paint: MapSettings = Field(default_factory=MapSettings, description="the map from the movies (`map`)")
    statistics: StatisticsSettings = Field(default_factory=StatisticsSettings, description="numbers of a report")


# How many names a key has, parted by dots.
DEPTHS: dict[type[BaseModel], tuple[int, ...]] = {Settings: (2,), SynthSettings: (1,), ProposerSettings: (2, 3)}


def load_settings(path: Path | None = None, overrides: Iterable[str] = ()) -> Settings:
    """Read settings from a file and single overrides.

    Args:
        path: YAML as `sphereorient settings` writes it, any keys left out; None: the defaults.
        overrides: texts `room.key=value`, value in YAML; later ones win.

    Raises:
        SettingsError: no such file, unknown key (the nearest known one is named), impossible value.
    """
    return _load(Settings, path, overrides)


def load_synth_settings(path: Path | None = None, overrides: Iterable[str] = ()) -> SynthSettings:
    """Read the settings of a synthetic experiment from a file and from overrides `key=value`; as `load_settings`."""
    return _load(SynthSettings, path, overrides)


def load_proposer_settings(path: Path | None = None, overrides: Iterable[str] = ()) -> ProposerSettings:
    """Read the settings of a proposer's training from a file and from overrides; as `load_settings`."""
    return _load(ProposerSettings, path, overrides)


def _load(model: type[Model], path: Path | None, overrides: Iterable[str]) -> Model:
    tree = {} if path is None else _read(path)
    for text in overrides:
        _override(tree, text, DEPTHS[model])
    source = str(path) if path else "settings"
    try:
        settings = model.model_validate(tree)
    except ValidationError as error:
        raise SettingsError(_explain(error, source, model)) from None
    if key := _not_finite(settings.model_dump()):
        do = "correct the value"
        raise SettingsError(refusal(f"{source}, {key}", expected="a finite number", got="another", do=do))
    return settings


def _not_finite(value: Any) -> str:
    """Return the key of a number that is infinite or none; nothing where all are finite."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, tuple | list) else ()
    for key, inner in items:
        if isinstance(inner, float) and not math.isfinite(inner):
            return str(key)
        if below := _not_finite(inner):
            return f"{key}.{below}"
    return ""


def _read(path: Path) -> dict[str, Any]:
    tree = read_yaml(path, SettingsError)
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise SettingsError(
            refusal(
                f"settings {path}", expected="keys and values", got=type(tree).__name__, do="see configs/default.yaml"
            )
        )
    return tree


def _override(tree: dict[str, Any], text: str, depths: tuple[int, ...]) -> None:
    """Put `key=value` into a tree, the key with a room before it where there are rooms."""
    key, equals, value = text.partition("=")
    *rooms, leaf = key.strip().split(".")
    if not equals or len(rooms) + 1 not in depths:
        expected = "key=value" if depths == (1,) else "room.key=value"
        raise SettingsError(
            refusal(f"--set {text}", expected=expected, got=repr(text), do="give one key and its value")
        )
    for room in rooms:
        branch = tree.setdefault(room, {})
        tree = branch if isinstance(branch, dict) else {}
    try:
        tree[leaf] = parse_yaml(value)
    except FAULTS:
        raise SettingsError(
            refusal(f"--set {text}", expected="a YAML value", got=short(value), do="quote it for the shell")
        ) from None


def _explain(error: ValidationError, source: str, model: type[BaseModel]) -> str:
    """Word pydantic's first complaint in one line."""
    first = error.errors()[0]
    if isinstance(refused := first.get("ctx", {}).get("error"), SettingsError):  # a room has worded it already
        return f"{source}, {refused}"
    parts = [str(part) for part in first["loc"]]
    key = ".".join(parts)
    if first["type"] == "extra_forbidden":
        known = _known_keys(model, parts[:-1])
        near = difflib.get_close_matches(parts[-1], known, 1)
        do = f"did you mean {'.'.join([*parts[:-1], near[0]])}" if near else f"use one of {', '.join(known)}"
        return refusal(f"{source}, {key}", expected="a known key", got="an unknown one", do=do)
    expected = first["msg"].replace("Input should be ", "")
    return refusal(f"{source}, {key}", expected=expected, got=short(first["input"]), do="correct the value")


def _known_keys(model: Any, parts: list[str]) -> list[str]:
    for part in parts:
        model = model.model_fields[part].annotation
    return list(model.model_fields)


def settings_yaml(settings: Settings | None = None) -> str:
    """Write settings as YAML with each key's description as a comment above it."""
    head = "# Settings of sphereorient; any key may be left out. --set room.key=value overrides one."
    return _tree_yaml(head, settings or Settings())


def synth_settings_yaml() -> str:
    """Write the settings of a synthetic experiment as YAML, commented likewise."""
    head = "# A synthetic experiment; any key may be left out. --set key=value overrides one."
    return "\n".join([head, "", *_commented(SynthSettings(), ""), ""])


def proposer_settings_yaml(settings: ProposerSettings | None = None) -> str:
    """Write the settings of a proposer's training as YAML, commented likewise."""
    head = "# Training of a proposer; any key may be left out. --set room.key=value overrides one."
    return _tree_yaml(head, settings or ProposerSettings())


def _tree_yaml(head: str, tree: BaseModel) -> str:
    lines = [head, ""]
    for room, field in type(tree).model_fields.items():
        lines += [f"{room}:  # {field.description}", *_commented(getattr(tree, room), "  "), ""]
    return "\n".join(lines)


def _commented(branch: BaseModel, indent: str) -> list[str]:
    lines = []
    for key, field in type(branch).model_fields.items():
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
