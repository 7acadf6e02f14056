"""The file of a trained proposer: weights and settings, without code."""

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Annotated, Any, NoReturn

import torch
from pydantic import BaseModel, Field, FiniteFloat, StrictInt
from torch import Tensor

from sphereorient.errors import CheckpointError, refusal
from sphereorient.files.whole_file import put_aside, read_whole
from sphereorient.files.yaml_file import short, validated
from sphereorient.learn.network import Correlator
from sphereorient.learn.settings import ProposerSettings

SCHEMA = "sphereorient-proposer/1"
LARGEST_BYTES = 64_000_000  # of the file, and of its uncompressed content
DO = "pass a proposer.ckpt of `sphereorient train`"

ShortText = Annotated[str, Field(max_length=500)]
Fact = Annotated[FiniteFloat, Field(strict=True)] | StrictInt | ShortText


class Checkpoint(BaseModel, frozen=True, extra="forbid", arbitrary_types_allowed=True):
    """A trained network; made by `train_proposer`, written by `save_checkpoint`, read by the proposer."""

    settings: ProposerSettings
    state: dict[str, Tensor]  # of a `Correlator`, float32
    temperature: float = Field(1.0, strict=True, ge=1e-2, le=1e2)  # of the logits, for calibrated probabilities
    texture_sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")  # of the map of a fine-tuning; None: any map
    about: dict[ShortText, Fact] = Field(default_factory=dict, max_length=64)  # versions, steps, metrics


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, equal ones with equal bytes. Raises CheckpointError: invalid; OutputError: unwritable."""
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
    # A stream, as torch would write a name into the file.
    with put_aside(path, also=(RuntimeError,)) as aside, aside.open("wb") as file:
        torch.save(tree, file)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint on the CPU without executing code; raise CheckpointError if file or weights are invalid."""
    name = f"checkpoint {path}"
    content = read_whole(path, LARGEST_BYTES, "a file of weights", CheckpointError, DO)
    _check_archive(content, name)
    try:
        # weights_only accepts tensors, numbers, texts and containers; any other name in the pickle is refused.
        tree = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # damaged pickles raise nearly anything
        code = "Weights only load failed" in str(error) or "Unsupported" in str(error)
        got = "other objects or code, which were not loaded" if code else "a damaged file"
        _refuse(name, "a file of weights", got, "train it again, or download it again", error)
    return _checked(tree, name)


def correlator_of(checkpoint: Checkpoint) -> Correlator:
    """Return the network of a checkpoint, for inference; `find_modes` takes the temperature."""
    network = Correlator(checkpoint.settings.network)
    network.load_state_dict(checkpoint.state)
    return network.eval().requires_grad_(False)


def texture_sha256(texture: Tensor) -> str:
    """Return the SHA-256 of a map's size and grey levels in 8 bits, whatever its file; (H, 2 H), not reduced."""
    grey = (texture.detach().cpu().double() * 255).round().clamp(0, 255).to(torch.uint8)
    size = "x".join(str(side) for side in grey.shape)
    return hashlib.sha256(size.encode() + grey.contiguous().numpy().tobytes()).hexdigest()


def check_texture(checkpoint: Checkpoint, texture: Tensor) -> None:
    """Raise CheckpointError if a map, (H, 2 H), not reduced, is not that of the fine-tuning."""
    own = checkpoint.texture_sha256
    if own is not None and own != (other := texture_sha256(texture)):
        expected, got = f"the map that it was fine-tuned on ({own[:12]})", f"another map ({other[:12]})"
        _refuse("checkpoint", expected, got, "pass a checkpoint for any map, or fine-tune again")


def _refuse(name: str, expected: str, got: str, do: str, cause: Exception | None = None) -> NoReturn:
    raise CheckpointError(refusal(name, expected=expected, got=got, do=do)) from cause


def _check_archive(content: bytes, name: str) -> None:
    """Refuse a file that is not torch's archive, or that expands when it is read."""
    try:
        entries = zipfile.ZipFile(io.BytesIO(content)).infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        _refuse(name, "a file of weights", "another file, or the beginning of one", DO, error)
    # torch does not compress. Compressed or overlapping entries can expand to any size.
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        _refuse(name, "a file of weights", "a compressed archive", DO)
    if sum(entry.file_size for entry in entries) > LARGEST_BYTES:
        _refuse(name, f"at most {LARGEST_BYTES / 1e6:g} MB", "an archive that claims more", DO)


def _checked(tree: Any, name: str) -> Checkpoint:
    if isinstance(tree, dict) and "pytorch-lightning_version" in tree:
        do = "pass the proposer.ckpt beside it; last.ckpt is for `sphereorient train --resume`"
        _refuse(name, f"schema {SCHEMA}", "a checkpoint of Lightning", do)
    schema = tree.get("schema") if isinstance(tree, dict) else None
    if schema != SCHEMA:
        got = short(schema) if isinstance(schema, str) else "none"
        _refuse(name, f"schema {SCHEMA}", got, "train it again with this version, or install the version that wrote it")
    # A file has every key; defaults are for new checkpoints.
    absent = dict.fromkeys(Checkpoint.model_fields.keys() - tree.keys(), "absent")
    content = {key: value for key, value in tree.items() if key != "schema"}
    checkpoint = validated(Checkpoint, content | absent, name, CheckpointError)
    state, known = checkpoint.state, Correlator(checkpoint.settings.network).state_dict()
    if others := sorted(short(key) for key in state.keys() ^ known.keys()):
        _refuse(f"{name}, state", f"{len(known)} tensors of the network", f"others: {', '.join(others[:3])}", DO)
    for key, tensor in state.items():
        if tensor.layout != torch.strided or tensor.dtype != torch.float32:
            _refuse(f"{name}, {key}", "a dense tensor of 32 bit floats", f"{tensor.layout}, {tensor.dtype}", DO)
        if tensor.shape != (shape := known[key].shape):
            _refuse(f"{name}, {key}", f"shape {tuple(shape)}", str(tuple(tensor.shape))[:60], DO)
        if not bool(tensor.isfinite().all()):
            _refuse(f"{name}, {key}", "finite numbers", "others", "train it again")
    return checkpoint
