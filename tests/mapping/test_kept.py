"""An interrupted run of `map` resumes, to the same bytes."""

from dataclasses import astuple

import pytest
import torch
from map_examples import unpainted

from sphereorient.errors import PaintError
from sphereorient.experiment.recording import open_recording
from sphereorient.files.threads import silent
from sphereorient.locate import LocateSettings
from sphereorient.mapping import MapSettings, fit_map, iterations, learn, take_crops
from sphereorient.mapping.learn import read_kept, write_kept
from sphereorient.pose.lights import kinds
from sphereorient.pose.lights.lab import LabLight

QUICK = MapSettings(rounds=3, pixels=300, height=32, baselines=(1, 2))


def test_a_damaged_file_is_no_state(tmp_path):
    parts = {"a": torch.arange(4096, dtype=torch.float64), "b": torch.tensor(True), "none": torch.zeros(0, 3)}
    path = tmp_path / "map.h5"
    assert read_kept(path) is None
    write_kept(path, parts)
    found = read_kept(path)
    assert found is not None
    assert all(torch.equal(found[name], part) and found[name].dtype == part.dtype for name, part in parts.items())
    content = bytearray(path.read_bytes())
    place = content.index(parts["a"][2000:2004].numpy().tobytes())
    content[place] ^= 1
    for damaged in (bytes(content), bytes(content)[:700]):
        path.write_bytes(damaged)
        assert read_kept(path) is None
    write_kept(path, parts)
    assert read_kept(path) is not None


@pytest.mark.slow
@pytest.mark.parametrize("of_cameras", [8, 1], ids=["light of each camera", "one light in the lab"])
def test_an_interrupted_run_goes_on_to_the_same_bytes(tmp_path, monkeypatch, of_cameras):
    monkeypatch.setattr(iterations, "LIGHT_ITERATIONS", of_cameras)
    monkeypatch.setattr(kinds, "CHANGED", 1e9)  # whether it is better or not
    path, kept = unpainted(tmp_path / "scene", frames=16), tmp_path / "map.h5"
    with open_recording(path, ["cam1"], textured=False) as recording:
        crops = take_crops(recording, QUICK, LocateSettings(), silent)
    steps = list[tuple[str, int, int]]()
    whole = fit_map(crops, QUICK, lambda *step: steps.append(step))
    assert {total for stage, done, total in steps if stage == "map" and done != total} == {0}, "it may end at any"
    iterate = iterations.iterate

    def interrupted(state, settings, k):
        if k == 2:
            raise KeyboardInterrupt
        return iterate(state, settings, k)

    def again(*_):
        raise PaintError("the chain is searched again")

    monkeypatch.setattr(iterations, "iterate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit_map(crops, QUICK, silent, kept)
    monkeypatch.setattr(iterations, "iterate", iterate)
    monkeypatch.setattr(learn, "_start_from_movie", again)
    resumed = fit_map(crops, QUICK, silent, kept)
    assert len(resumed.rounds) == 3
    assert isinstance(resumed.light, LabLight) == (of_cameras == 1)
    for name in ("texture", "R_lab_body", "position_lab_mm", "seen", "sigma", "paint"):
        torch.testing.assert_close(getattr(resumed, name), getattr(whole, name), rtol=0, atol=0, equal_nan=True)
    assert [astuple(one) for one in resumed.rounds] == [astuple(one) for one in whole.rounds]
    assert astuple(resumed.closure) == astuple(whole.closure)
