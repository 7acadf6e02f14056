"""A trained proposer in a file: weights, the settings that they belong to, and nothing that could be executed."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import torch
from pydantic import ValidationError
from torch import Tensor

from sphereorient.errors import CheckpointError, SphereOrientError, refusal
from sphereorient.files.outputs import put_aside
from sphereorient.learn.network import Correlator
from sphereorient.learn.settings import NetworkSettings, ProposerSettings

SCHEMA = "sphereorient-proposer/1"
LARGEST_BYTES = 64_000_000  # of the file, and of what is packed in it
TEMPERATURES = (1e-2, 1e2)  # between which one can be
MOST_FACTS = 64  # entries of `about`
LONGEST_FACT = 500  # letters
KEYS = frozenset({"schema", "settings", "state", "temperature", "texture_sha256", "about"})
DO = "pass a proposer.ckpt of `sphereorient train`"

Facts = Mapping[str, str | int | float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """A trained network; made by `learn.train`, kept by `save_checkpoint`, read by the proposer."""

    settings: ProposerSettings
    state: Mapping[str, Tensor]  # of a `Correlator`, float32
    temperature: float = 1.0  # for `tops_of`: with it probabilities keep what they promise
    texture_sha256: str | None = None  # of the one map that it was fine-tuned on, see `texture_sha256`; None: any map
    about: Facts = field(default_factory=dict)  # versions, steps, figures of the validation


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; the same one gives the same bytes.

    Raises:
        CheckpointError: it holds what `load_checkpoint` would refuse.
        OutputError: the file cannot be written.
    """
    state = {name: tensor.detach().cpu().float().contiguous().clone() for name, tensor in checkpoint.state.items()}
    tree = {
        "schema": SCHEMA,
        "settings": checkpoint.settings.model_dump(mode="json"),
        "state": state,
        "temperature": float(checkpoint.temperature),
        "texture_sha256": checkpoint.texture_sha256,
        "about": dict(checkpoint.about),
    }
    _checked(tree, str(path))
    with put_aside(path, also=(RuntimeError,)) as aside:
        torch.save(tree, aside)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint on the CPU; nothing in the file is executed.

    Raises:
        CheckpointError: no such file, too large, damaged, another version, code inside, or weights of other shapes.
    """
    name = f"checkpoint {path}"
    _check_archive(path, name)
    try:
        # Tensors, numbers, texts and containers alone; any other name in the pickle is refused before it is called.
        tree = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged pickles raise nearly anything
        code = "Weights only load failed" in str(error) or "Unsupported" in str(error)
        got = "one that holds other objects or code, which were not loaded" if code else "a damaged one"
        _refuse(name, "a file of weights", got, "train it anew, or fetch it again", error)
    return _checked(tree, name)


def correlator_of(checkpoint: Checkpoint) -> Correlator:
    """Return the network with the weights of a checkpoint, for use; `tops_of` wants the temperature."""
    network = Correlator(checkpoint.settings.network)
    network.load_state_dict(dict(checkpoint.state))
    return network.eval().requires_grad_(False)


def texture_sha256(texture: Tensor) -> str:
    """Return the fingerprint of a map's grey levels, whatever file they came from.

    Args:
        texture: (H, 2 H), 0 black .. 1 white, as `load_texture` gives it, not reduced.

    Returns:
        SHA-256 of the size and of the grey levels in 8 bits, hexadecimal.
    """
    grey = (texture.detach().cpu().double() * 255).round().clamp(0, 255).to(torch.uint8)
    size = "x".join(str(side) for side in grey.shape)
    return hashlib.sha256(size.encode() + grey.contiguous().numpy().tobytes()).hexdigest()


def check_texture(checkpoint: Checkpoint, texture: Tensor) -> None:
    """Refuse a map other than the one that a checkpoint was fine-tuned on.

    Args:
        checkpoint: one for any map is content with all.
        texture: (H, 2 H), as `load_texture` gives it, not reduced.

    Raises:
        CheckpointError: another map.
    """
    own = checkpoint.texture_sha256
    if own is not None and own != (other := texture_sha256(texture)):
        expected, got = f"the map that it was fine-tuned on ({own[:12]})", f"another ({other[:12]})"
        raise CheckpointError(
            refusal("checkpoint", expected=expected, got=got, do="pass a checkpoint for any map, or fine-tune anew")
        )


def _refuse(name: str, expected: str, got: str, do: str, cause: Exception | None = None) -> NoReturn:
    raise CheckpointError(refusal(name, expected=expected, got=got, do=do)) from cause


def _check_archive(path: Path, name: str) -> None:
    """Refuse what is no archive of torch's, or would grow when it is read."""
    try:
        size = path.stat().st_size if path.is_file() else -1
    except OSError as error:
        _refuse(name, "a file that can be read", f"'{error.strerror}'", DO, error)
    if size < 0:
        _refuse(name, "a file", "a folder" if path.is_dir() else "none", DO)
    if size > LARGEST_BYTES:
        _refuse(name, f"at most {LARGEST_BYTES / 1e6:g} MB", f"{size / 1e6:.1f} MB", DO)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        _refuse(name, "a file of weights", "another file, or the beginning of one", DO, error)
    # torch packs nothing. What is packed, or overlaps, can grow to any size.
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        _refuse(name, "a file of weights", "a packed archive", DO)
    if sum(entry.file_size for entry in entries) > LARGEST_BYTES:
        _refuse(name, f"at most {LARGEST_BYTES / 1e6:g} MB", "one that claims more", DO)


def _checked(tree: Any, name: str) -> Checkpoint:
    """Make a checkpoint of what was read, every part of it looked at."""
    if not isinstance(tree, dict) or not all(isinstance(key, str) for key in tree):
        _refuse(name, f"schema {SCHEMA}", "something else", DO)
    if "pytorch-lightning_version" in tree:
        do = "pass the proposer.ckpt beside it; last.ckpt is what `sphereorient train --resume` goes on from"
        _refuse(name, f"schema {SCHEMA}", "one of Lightning's, to go on training from", do)
    schema = tree.get("schema")
    if schema != SCHEMA:
        got = _short(schema) if isinstance(schema, str) else "none"
        _refuse(name, f"schema {SCHEMA}", got, "train it anew with this version, or install the one that wrote it")
    if tree.keys() != KEYS:
        different = ", ".join(sorted(_short(key) for key in tree.keys() ^ KEYS)[:3])
        _refuse(name, f"keys {', '.join(sorted(KEYS))}", f"too many or too few: {different}", DO)
    settings = _settings(tree["settings"], name)
    temperature, sha256 = tree["temperature"], tree["texture_sha256"]
    low, high = TEMPERATURES
    if not isinstance(temperature, float) or not low <= temperature <= high:
        _refuse(f"{name}, temperature", f"a number in {low:g} .. {high:g}", _short(temperature), DO)
    if sha256 is not None and not (
        isinstance(sha256, str) and len(sha256) == 64 and set(sha256) <= set("0123456789abcdef")
    ):
        _refuse(f"{name}, texture_sha256", "64 hexadecimal digits or none", _short(sha256), DO)
    return Checkpoint(
        settings=settings,
        state=_state(tree["state"], settings.network, name),
        temperature=temperature,
        texture_sha256=sha256,
        about=_facts(tree["about"], name),
    )


def _settings(tree: Any, name: str) -> ProposerSettings:
    try:
        return ProposerSettings.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part)[:40] for part in first["loc"][:4])
        words = str(first["msg"]).splitlines()[0][:200]
        _refuse(f"{name}, settings {key}".rstrip(), "settings of this version", f"'{words}'", DO, error)
    except SphereOrientError as error:
        raise CheckpointError(f"{name}, {error}") from error


def _state(tree: Any, settings: NetworkSettings, name: str) -> dict[str, Tensor]:
    """Look at weights: those of the network that the settings describe, and finite."""
    if not isinstance(tree, dict):
        _refuse(f"{name}, state", "weights by name", _short(tree), DO)
    expected = {key: tuple(tensor.shape) for key, tensor in Correlator(settings).state_dict().items()}
    if tree.keys() != expected.keys():
        different = ", ".join(sorted(_short(key) for key in tree.keys() ^ expected.keys())[:3])
        _refuse(f"{name}, state", f"{len(expected)} tensors of the network", f"others: {different}", DO)
    for key, shape in expected.items():
        tensor = tree[key]
        if type(tensor) is not Tensor or tensor.layout != torch.strided or tensor.dtype != torch.float32:
            _refuse(f"{name}, {key}", "a tensor of 32 bit floats", str(getattr(tensor, "dtype", "none")), DO)
        if tuple(tensor.shape) != shape:
            _refuse(f"{name}, {key}", f"shape {shape}", str(tuple(tensor.shape))[:60], DO)
        if not bool(tensor.isfinite().all()):
            _refuse(f"{name}, {key}", "finite numbers", "others", "train it anew")
    return tree


def _facts(tree: Any, name: str) -> dict[str, str | int | float]:
    known = isinstance(tree, dict) and len(tree) <= MOST_FACTS
    if known:
        for key, value in tree.items():
            number = type(value) in (int, float) and abs(value) < 1e15
            text = type(value) is str and len(value) <= LONGEST_FACT
            known = known and type(key) is str and len(key) <= LONGEST_FACT and (number or text)
    if not known:
        _refuse(f"{name}, about", f"at most {MOST_FACTS} numbers and texts by name", "something else", DO)
    return dict(tree)


def _short(value: Any) -> str:
    """Return a value as one short line; containers by their type alone."""
    if isinstance(value, str):
        return repr(value[:40])
    return f"{value:g}" if isinstance(value, float) and math.isfinite(value) else type(value).__name__
