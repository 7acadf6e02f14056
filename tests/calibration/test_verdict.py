"""The verdict of a calibration: structured residuals, dropped points, lenses beyond belief, and a wall left out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from calibration_examples import cameras, document, planted, port, views

from sphereorient.calibration import calibrate_cameras, plates
from sphereorient.calibration.calibrated import doubts
from sphereorient.calibration.document import Picture


def calibrated(monkeypatch, seen, known):
    """Calibrate from views as if they had been found in pictures."""
    pictures = {
        Picture(camera=name, row=row, path=known.path.with_name(f"{name}_{row:02}.png")): view
        for name, rows in seen.items()
        for row, view in rows.items()
    }
    monkeypatch.setattr(plates, "see_pictures", lambda *_: pictures)
    return calibrate_cameras(replace(known, pictures=tuple(pictures)))


def rig_and_views(walls, noise_px=0.03, seed=3, model="tsai"):
    """What cameras see that look a little aslant at their walls, as in ../shared/tank."""
    rng = torch.Generator().manual_seed(seed)
    rig = replace(planted(rng, model, count=10), cameras=cameras(model, walls, turned_deg=5.0))
    return rig, views(rig, rng, noise_px)


@pytest.mark.slow
def test_a_plate_behind_a_wall_that_nobody_described_is_told_with_its_cause(monkeypatch):
    """Before: no word. After: structure over the noise, and the wall's place and index that explain it."""
    rig, seen = rig_and_views(walls=True)
    result = calibrated(monkeypatch, seen, document(rig))
    print(result.verdict, result.rms_px("cam1"), result.rms_px("cam2"), doubts(result), result.cameras)
    assert any("neighbouring points miss alike" in line for line in result.verdict)
    assert "a flat wall" in result.verdict[-1]
    assert "describe the wall under `ports`" in result.verdict[-1]


@pytest.mark.slow
@pytest.mark.parametrize("walls", [False, True])
def test_a_right_calibration_has_no_verdict(monkeypatch, walls):
    for seed in range(2):
        rig, seen = rig_and_views(walls, seed=seed)
        ports = {name: port(name) for name in seen} if walls else None
        assert calibrated(monkeypatch, seen, document(rig, ports=ports)).verdict == ()


@pytest.mark.slow
def test_a_lens_of_another_model_is_told(monkeypatch):
    rig, seen = rig_and_views(walls=False, model="brown")
    result = calibrated(monkeypatch, seen, document(rig, model="pinhole"))
    print(result.verdict)
    assert "`model: brown`" in result.verdict[-1]
