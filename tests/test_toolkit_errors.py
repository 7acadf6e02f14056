"""Mistakes at the toolkit's edge: each is refused in one line: expected, got, do."""

import math

import numpy as np
import pytest
import torch

import sphereorient
from sphereorient import PathLayer, PoseFitter, SphereRenderer, TemplateBank, so3
from sphereorient.cameras import PinholeCamera
from sphereorient.errors import SphereOrientError
from sphereorient.search import OrientSettings
from sphereorient.sphere.texture import random_texture

TEXTURE = random_texture("patches", seed=3, height=32)
CAMERA = PinholeCamera(
    image_size=(64, 64),
    f_px=torch.tensor(800.0),
    centre_px=torch.tensor([31.5, 31.5]),
    R_cam_lab=torch.eye(3),
    T_cam_lab_mm=torch.tensor([0.0, 0.0, 500.0]),
)
R = so3.exp(torch.tensor([0.4, -0.9, 0.2], dtype=torch.float64))
COARSE = OrientSettings(coarse_step_deg=30.0)
ROTATIONS = r"R_lab_body: expected rotations, .*; make them with so3\.exp"
NUMBERS = r"texture: expected floating-point numbers, 0 black \.\. 1 white, got .* up to 255; convert it"


def disk(R_view_body: object) -> torch.Tensor:
    return SphereRenderer(TEXTURE, size_px=24)(R_view_body)


def bank(texture: object = TEXTURE, size_px: int = 24) -> TemplateBank:
    return TemplateBank(texture, size_px, COARSE)


def fit(pictures: object, start: torch.Tensor = R) -> object:
    return PoseFitter(CAMERA, TEXTURE, radius_mm=9.0, diameter_px=28.0)(pictures, start, torch.zeros(3))


def path(factor: float = 1.0, time_s: tuple[float, ...] = (0.0, 1.0, 2.0)) -> object:
    return PathLayer()(factor * R.expand(3, 2, 3, 3), torch.zeros(3, 2), torch.tensor(time_s))


MISTAKES = {
    "a map's file": (lambda: bank("texture.png"), r"texture: expected numbers, got str; .*load_texture"),
    "a map on its side": (lambda: bank(TEXTURE.T), r"texture: expected \(H, 2 H\)"),
    "a map of integers": (lambda: bank((255 * TEXTURE / TEXTURE.max()).round().int()), NUMBERS),
    "a map in grey levels": (lambda: bank((255 * TEXTURE / TEXTURE.max()).numpy()), NUMBERS),
    "a map in grey levels with unseen texels": (
        lambda: bank(torch.where(TEXTURE > 0.5, 255 * TEXTURE, torch.nan)),
        NUMBERS,
    ),
    "no size": (lambda: bank(size_px=0), r"size_px: expected 1 or more, got 0"),
    "a disk cut off": (lambda: bank()(disk(R)[1:]), r"disks: expected \(F, 24, 24\), got \(1, 23, 24\)"),
    "a disk with NaN": (lambda: bank()(math.nan * disk(R)), r"disks: expected finite grey levels, got 576 of 576"),
    "text for a disk": (lambda: bank()("disk.png"), r"disks: expected numbers, got str"),
    "a scaled matrix": (lambda: disk(2 * R), ROTATIONS),
    "a reflection": (lambda: disk(-R), ROTATIONS),
    "a matrix of integers": (lambda: disk(np.eye(3, dtype=int)), r"R_lab_body: expected a floating-point tensor"),
    "a picture with NaN": (lambda: fit(torch.full((64, 64), math.nan)), r"pictures: expected finite grey levels"),
    "a start that is no rotation": (lambda: fit(torch.zeros(64, 64), R + 0.1), ROTATIONS),
    "a fitter of a camera's file": (
        lambda: PoseFitter("cameras.yaml", TEXTURE, radius_mm=9.0, diameter_px=28.0),
        r"cameras: expected cameras, got str; pass one of load_cameras",
    ),
    "a fitter of all cameras by name": (
        lambda: PoseFitter({"cam1": CAMERA}, TEXTURE, radius_mm=9.0, diameter_px=28.0),
        r"cameras: expected cameras, got dict; pass one of load_cameras",
    ),
    "a fitter without radius": (
        lambda: PoseFitter(CAMERA, TEXTURE, radius_mm=0.0, diameter_px=28.0),
        r"radius_mm: expected a number above 0",
    ),
    "a path of no rotations": (lambda: path(2.0), ROTATIONS),
    "a path back in time": (lambda: path(time_s=(0.0, 2.0, 1.0)), r"time_s: expected increasing times"),
    "movies for an experiment": (
        lambda: sphereorient.track_movies(["cam1.mkv", "cam2.mkv"]),
        r"experiment: expected the path of an experiment\.yaml, got list; .*sphereorient init",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused_in_one_line(name):
    call, words = MISTAKES[name]
    with pytest.raises(SphereOrientError, match=words) as refused:
        call()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("form", [torch.Tensor.double, torch.Tensor.float, torch.Tensor.numpy])
def test_a_bank_takes_both_types_and_arrays(form):
    made = bank(form(TEXTURE))
    grey = disk(R.float())
    (ours,), expected = made(form(grey)[None]).R_view_body, bank()(grey).R_view_body
    assert torch.equal(ours.nan_to_num(), expected.nan_to_num())


def test_unknown_values_stay_unknown_and_rounding_errors_are_accepted():
    so3.check_rotations("R", torch.stack([R, R * math.nan]))
    so3.check_rotations("R", R.half().float())
    so3.check_rotations("R", torch.zeros(0, 3, 3))


def test_a_name_that_is_not_there_is_answered_with_those_that_are():
    with pytest.raises(AttributeError, match=r"no attribute 'track'; it has .*track_movies"):
        sphereorient.track("movie.mkv")
