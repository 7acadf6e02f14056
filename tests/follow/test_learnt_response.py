"""The response of a camera is learnt where the pictures show it, reported, and kept with the appearance."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from run_examples import off_deg

from sphereorient.cameras.response import Response
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.follow.appearance import response
from sphereorient.methods.method import load_learnt, save_learnt
from sphereorient.run.stages import run
from sphereorient.run.store import MemoryStore, Request
from sphereorient.synth import SynthSettings, write_synthetic_experiment

GAMMA = 2.2


def coded_grey(light):
    """Grey levels of a camera with gamma."""
    return (255.0 * (light / 255.0) ** (1 / GAMMA)).round().astype(np.uint8)


def test_white_that_is_cut_off_gives_no_response(monkeypatch):
    clipped = torch.zeros(4, 100, dtype=torch.bool)
    clipped[1::2, :10] = True  # a tenth of the disks of the second camera
    pixels = SimpleNamespace(clipped=clipped, inside=torch.ones_like(clipped))
    fitter = SimpleNamespace(views=[SimpleNamespace(response=None)] * 2, model=lambda: None)
    studied = SimpleNamespace(pixels=pixels, fitter=fitter, fit=None, use=torch.ones(2, 2, dtype=torch.bool))
    asked = []
    monkeypatch.setattr(response, "with_more_blur", lambda _: None)
    monkeypatch.setattr(response, "response_exponents", lambda *_: (torch.tensor([0.5, 0.5]), torch.full((2,), 0.01)))
    monkeypatch.setattr(response, "light_and_blur", lambda lit, **_: lit)
    monkeypatch.setattr(response, "_responding", lambda _, gamma: asked.append(gamma) or studied)
    response.with_response(studied, given=True)
    assert all(gamma[0] > 0 and gamma[1] == 0 for gamma in asked)
    assert asked


@pytest.mark.slow
def test_a_coded_camera_beside_a_linear_one_is_learnt_reported_and_kept(tmp_path):
    linear = write_synthetic_experiment(tmp_path, SynthSettings(frames=48, seed=5))
    as_filmed = run(Request(experiment=linear), MemoryStore())
    document = yaml.safe_load(linear.read_text())
    movie = open_movies(load_experiment(linear))["cam2"]
    np.save(tmp_path / "coded.npy", coded_grey(np.stack(list(movie.frames()))))
    empty = Image.open(tmp_path / document["backgrounds"]["cam2"])
    Image.fromarray(coded_grey(np.asarray(empty))).save(tmp_path / "coded.png")
    document["movies"]["cam2"], document["backgrounds"]["cam2"] = "coded.npy", "coded.png"
    coded, known = tmp_path / "coded.yaml", tmp_path / "learnt.h5"
    coded.write_text(yaml.safe_dump(document))

    track = run(Request(experiment=coded, save_learnt=known), MemoryStore())
    learnt = [scene.response for scene in load_learnt(known)[""].scenes.values()]
    assert learnt[0] is None
    assert abs(learnt[1].gamma - GAMMA) < 0.1
    assert track.provenance["response"] == f"cam1 linear, cam2 gamma {learnt[1].gamma:.3g}"
    assert [line.split(" are ")[0] for line in track.provenance["remarks"]] == ["grey levels of cam2"]
    assert np.median(off_deg(track, linear)) < 1.3 * np.median(off_deg(as_filmed, linear))
    again = run(Request(experiment=coded, learnt=known), MemoryStore())
    np.testing.assert_array_equal(again.orientation, track.orientation)

    of_a, of_b = learnt, [Response(table=((0.0, 0.0), (0.4, 0.1), (1.0, 1.0))), Response(srgb=True)]
    one = load_learnt(known)[""]
    scenes = zip(one.scenes.items(), of_b, strict=True)
    other = replace(one, scenes={name: replace(scene, response=curve) for (name, scene), curve in scenes})
    save_learnt({"a": one, "b": other}, tmp_path / "both.h5")
    balls = load_learnt(tmp_path / "both.h5")
    assert [[scene.response for scene in balls[name].scenes.values()] for name in ("a", "b")] == [of_a, of_b]

    document["response"] = {"cam2": "linear"}
    coded.write_text(yaml.safe_dump(document))
    undone = run(Request(experiment=coded), MemoryStore())
    assert undone.provenance["response"] == "cam1 linear, cam2 linear"
    assert np.median(off_deg(undone, linear)) > np.median(off_deg(track, linear))
