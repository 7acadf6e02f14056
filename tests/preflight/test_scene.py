"""The check of several balls: too many or too few named, balls that are not found, sizes, and exchanged names."""

import shutil
from types import SimpleNamespace

import pytest
import torch
import yaml

from sphereorient import so3
from sphereorient.experiment import Sphere
from sphereorient.files.threads import silent
from sphereorient.locate.outline import Outline
from sphereorient.preflight import preflight
from sphereorient.preflight.finding import FAULT, OK, WARNING
from sphereorient.preflight.scene import ball_sizes, disk_counts, found_balls, look_at_scene, same_paint
from sphereorient.sphere.compare import turned_map
from sphereorient.sphere.texture import random_texture
from sphereorient.synth import SynthSettings, write_synthetic_experiment

PX_PER_MM = 4.0


class Camera:
    """A telecentric camera that looks along z."""

    def project(self, position_lab_mm: torch.Tensor) -> torch.Tensor:
        return PX_PER_MM * position_lab_mm[..., :2]


def view(name: str, diameter_mm: float) -> SimpleNamespace:
    size = PX_PER_MM * diameter_mm
    radius = lambda X, radius_mm: torch.full((len(X),), PX_PER_MM * radius_mm)  # noqa: E731
    return SimpleNamespace(name=name, camera=Camera(), diameter_px=size, radius_px=radius)


def balls(**diameters_mm: float) -> dict[str, SimpleNamespace]:
    return {
        name: SimpleNamespace(fitter=SimpleNamespace(views=[view("cam1", mm), view("cam2", mm)], radius_mm=mm / 2))
        for name, mm in diameters_mm.items()
    }


def poses(x_mm: float | None) -> SimpleNamespace:
    """A pose of both cameras at (x, 0, 0), or none."""

    class Found(SimpleNamespace):
        def __len__(self) -> int:
            return int(x_mm is not None)

    return Found(position_lab_mm=torch.tensor([[x_mm or 0.0, 0.0, 0.0]]).double(), use=torch.ones(2, dtype=torch.bool))


def disk(x_mm: float, diameter_mm: float) -> Outline:
    return Outline(u_px=PX_PER_MM * x_mm, v_px=0.0, radius_px=PX_PER_MM * diameter_mm / 2, rms_px=0.1, coverage=0.9)


def size_findings(x_mm: dict[str, float | None], true_mm: dict[float, float], **named: float):
    """Findings on sizes of balls found at x, with disks of true diameters."""
    seen = [disk(x, mm) for x, mm in true_mm.items()]
    found = {name: poses(x) for name, x in x_mm.items()}
    return {one.title.removeprefix("size of ball "): one for one in ball_sizes([found], [[seen, seen]], balls(**named))}


def test_more_and_fewer_disks_than_named_balls_are_reported():
    seen = [[[disk(0, 14), disk(30, 14)], [disk(0, 14)]]] * 3
    first, second = disk_counts(seen, balls(a=14.0))
    assert (first.severity, second.severity) == (WARNING, OK)
    assert "2 disks in the usual frame (2 to 2), 1 named" in first.measured
    assert "name the other balls" in first.advice
    first, second = disk_counts(seen, balls(a=14.0, b=14.0))
    assert (first.severity, second.severity) == (OK, WARNING)
    assert "remove absent balls" in second.advice


def test_a_ball_that_is_never_found_is_a_fault_and_one_found_now_and_then_a_warning():
    found = [{"a": poses(0.0), "b": poses(None), "c": poses(0.0 if k < 2 else None)} for k in range(4)]
    a, b, c = found_balls(found, balls(a=14.0, b=14.0, c=14.0))
    assert [a.severity, b.severity, c.severity] == [OK, FAULT, WARNING]
    assert b.measured == "found by its paint in 0 of 4 frames"
    assert "spheres.b" in b.advice


def test_sizes_are_measured_and_wrong_ones_reported_with_the_one_that_fits():
    right = size_findings({"a": 0.0, "b": 50.0}, {0.0: 14.0, 50.0: 20.0}, a=14.0, b=20.0)
    assert [one.severity for one in right.values()] == [OK, OK]
    wrong = size_findings({"a": 0.0, "b": 50.0}, {0.0: 14.0, 50.0: 18.0}, a=14.0, b=20.0)
    assert [one.severity for one in wrong.values()] == [OK, FAULT]
    assert "spheres.b.diameter 18 would fit" in wrong["b"].advice
    assert wrong["b"].measured == "18 mm in the pictures, 20 mm named"


def test_exchanged_diameters_or_maps_are_reported_of_both_balls():
    found = size_findings({"a": 0.0, "b": 50.0}, {0.0: 14.0, 50.0: 16.0}, a=16.0, b=14.0)
    assert [one.severity for one in found.values()] == [FAULT, FAULT]
    assert found["a"].advice == "the diameters, or the textures, of a and b are exchanged: correct `spheres`"


def test_a_disk_elsewhere_gives_no_size_of_a_ball():
    assert size_findings({"a": 0.0}, {30.0: 18.0}, a=14.0) == {}


def test_missing_maps_are_reported_ball_by_ball(tmp_path):
    spheres = (Sphere(name="a", diameter_mm=14.0), Sphere(name="b", diameter_mm=14.0, texture_path=tmp_path / "t.png"))
    recording = SimpleNamespace(experiment=SimpleNamespace(spheres=spheres))
    scene, found = look_at_scene(recording, SimpleNamespace(), lambda *_: None)
    assert scene == ()
    assert [one.title for one in found] == ["paint of ball a", "paint of ball b"]
    assert {one.severity for one in found} == {FAULT}
    assert "t.png is not there" in found[1].measured


@pytest.mark.slow  # 10 s
def test_two_maps_of_one_paint_are_reported():
    a, b = (torch.nn.functional.avg_pool2d(random_texture("patches", seed)[None], 8)[0] for seed in (3, 4))
    turned = turned_map(a, so3.exp(torch.tensor([[0.4, -1.1, 0.7]], dtype=torch.float64))[0])
    (finding,) = same_paint({"a.png": a, "b.png": b, "c.png": turned}, silent)
    assert (finding.title, finding.severity) == ("paint of a.png and c.png", WARNING)


@pytest.mark.slow  # two balls are searched
def test_maps_of_one_name_in_two_folders_are_told_apart(tmp_path):
    """Before: the last one stood for both; nothing was said of the other one, nor that the paint is the same."""
    settings = SynthSettings(
        frames=24, balls=2, paints=1, image_size=(220, 200), diameter_mm=12.0, diameter_px=40.0, volume_mm=30.0, seed=2
    )
    path = write_synthetic_experiment(tmp_path / "two", settings)
    document = yaml.safe_load(path.read_text())
    for name, ball in document["spheres"].items():
        (path.parent / name).mkdir()
        shutil.copy(path.parent / ball["texture"], path.parent / name / "texture.png")
        ball["texture"] = f"{name}/texture.png"
    path.write_text(yaml.safe_dump(document))
    titles = [one.title for one in preflight(path).findings]
    assert {"paint a/texture.png", "paint b/texture.png", "paint of a/texture.png and b/texture.png"} <= set(titles)
