"""Small rendered movies of a turning ball, and maps that are spoilt in known ways."""

import math
from pathlib import Path

import cv2
import h5py
import torch
import yaml
from torch import Tensor

from sphereorient.experiment.recording import Recording, open_recording
from sphereorient.files.threads import silent
from sphereorient.locate import LocateSettings
from sphereorient.mapping import LearntMap, MapSettings, fit_map, take_crops
from sphereorient.mapping.disks import Crops
from sphereorient.mapping.iterations import State, first_state, iterate
from sphereorient.sphere import load_texture, reduced_texture, sample_texture
from sphereorient.sphere.texture import map_directions
from sphereorient.synth import SynthSettings, write_synthetic_experiment

# 4.6 degrees a frame: both cameras together have seen the whole ball after a few dozen frames.
SMALL = {
    "frames": 48,
    "image_size": (180, 180),
    "diameter_px": 50.0,
    "volume_mm": 15.0,
    "exposure": 1e-4,
    "exposure_samples": 1,
    "omega_rms": 40.0,
    "seed": 5,
}
QUICK = ["--set", "paint.rounds=4", "--set", "paint.pixels=600", "--set", "paint.height=64"]


def unpainted(folder: Path, **changed: object) -> Path:
    """Render an experiment without `texture:`; the map lies beside it as texture.png."""
    path = write_synthetic_experiment(folder, SynthSettings(**{**SMALL, **changed}))
    rewrite(path, texture=None)
    return path


def rewrite(path: Path, texture: str | None = None, **changed: object) -> None:
    """Change keys of an experiment: its map, and keys of the top level; None takes them away."""
    document = yaml.safe_load(path.read_text())
    document["sphere"].pop("texture", None)
    if texture is not None:
        document["sphere"]["texture"] = texture
    for key, value in changed.items():
        document.pop(key, None)
        if value is not None:
            document[key] = value
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def true_attitudes(experiment: Path) -> Tensor:
    """Attitudes (N, 3, 3) of truth.h5 beside an experiment."""
    with h5py.File(experiment.parent / "truth.h5") as file:
        return torch.from_numpy(file["orientation"][()])


def shift_field(direction: Tensor, rms_deg: float) -> Tensor:
    """A smooth field of rotation vectors, (..., 3), rad, that moves directions (..., 3) by so much, rms."""
    x, y, z = direction.unbind(-1)
    turn = torch.stack([torch.sin(2 * y + 1), torch.cos(3 * z), torch.sin(2 * x - 0.5)], dim=-1)
    everywhere = map_directions(48)
    a, b, c = everywhere.unbind(-1)
    whole = torch.stack([torch.sin(2 * b + 1), torch.cos(3 * c), torch.sin(2 * a - 0.5)], dim=-1)
    moved = torch.linalg.cross(whole, everywhere).square().sum(-1)
    area = everywhere[..., 2].square().neg().add(1).sqrt()
    return turn * math.radians(rms_deg) / float((moved * area).sum() / area.sum()) ** 0.5


def warped(texture: Tensor, rms_deg: float) -> Tensor:
    """Return a map (H, 2 H) whose paint is shifted smoothly: it shows at d what lay at exp(field(d)) d."""
    height = len(texture)
    direction = map_directions(height)
    moved = torch.nn.functional.normalize(
        direction + torch.linalg.cross(shift_field(direction, rms_deg), direction), dim=-1
    )
    return sample_texture(texture.double(), moved).to(texture.dtype)


def save_map(texture: Tensor, path: Path) -> Path:
    """Write a map as 8-bit picture."""
    cv2.imwrite(str(path), (255 * texture).round().clamp(0, 255).byte().numpy())
    return path


def mapped(recording: Recording, settings: MapSettings) -> LearntMap:
    """Learn a map from an opened recording."""
    return fit_map(take_crops(recording, settings, LocateSettings(), silent), settings, silent)


def settled(path: Path, R: Tensor, settings: MapSettings) -> tuple[Crops, State]:
    """Return the crops of a rendered movie, and the state after two iterations from its true map and attitudes."""
    texture = reduced_texture(load_texture(path.parent / "texture.png"), 64.0)
    with open_recording(path, textured=False) as recording:
        crops = take_crops(recording, settings, LocateSettings(), silent)
    state = first_state(crops, torch.arange(len(R)), R, texture, settings)
    for k in range(2):
        state, _ = iterate(state, settings, k)
    return crops, state
