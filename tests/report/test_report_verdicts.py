import re
from dataclasses import replace

import numpy as np
import pytest
from ensembles import EnsembleSpec, draw_ensemble, filtered_track

from sphereorient.report.verdicts import verdicts
from sphereorient.statistics import StatisticsSettings, summarise
from sphereorient.statistics.cameras import CameraDistance

ACTION = re.compile(r".*; (if this is not meant|see|run|pass|track|read|compute) [^;]*$")  # its end is the advice
FEW = StatisticsSettings(resamples=100)


def verdicts_by_title(track, distances=(), settings=FEW):
    tracks = track if isinstance(track, dict) else {"track.h5": track}
    found = verdicts(summarise(list(tracks.values()), settings), tracks, distances)
    assert all(verdict.words and not verdict.words.endswith(".") for verdict in found)
    assert all(verdict.grade != "doubt" or ACTION.match(verdict.words) for verdict in found)
    return {verdict.title: verdict for verdict in found}


@pytest.fixture(scope="module")
def lab():
    return draw_ensemble(EnsembleSpec(segments=250, mean_frames=90.0), 11)


@pytest.fixture(scope="module")
def body():
    spec = EnsembleSpec(segments=250, mean_frames=90.0, frame="body", omega_rms=(7.0, 12.0, 8.0))
    return draw_ensemble(spec, 12)


@pytest.mark.slow
def test_a_flow_with_axes_is_distinguished_from_a_body_with_axes(body):
    flow = draw_ensemble(EnsembleSpec(segments=250, mean_frames=90.0, omega_rms=(7.0, 12.0, 8.0)), 12)
    assert "prefers directions of the lab and none of the body" in verdicts_by_title(flow)["Isotropy of omega"].words
    assert "prefers directions of the body and none of the lab" in verdicts_by_title(body)["Isotropy of omega"].words


@pytest.mark.slow
def test_rows_that_belong_to_no_frame_are_reported(lab):
    good = verdicts_by_title(lab)
    assert good["Frame of omega_lab"].grade == "good"
    assert good["Frame of omega_body"].grade == "good"
    printed = np.einsum("nij,nj->ni", lab.orientation_smooth, lab.omega_lab)  # docs/errata.md E6: R omega_lab
    wrong = verdicts_by_title(replace(lab, omega_lab=printed, omega_body=lab.omega_lab))
    assert wrong["Frame of omega_lab"].grade == "doubt"
    assert "not in lab or body components" in wrong["Frame of omega_lab"].words
    assert "written in lab components" in wrong["Frame of omega_body"].words


@pytest.mark.slow
def test_tails_are_named_by_their_kind(lab):
    found = verdicts_by_title(lab)
    assert "heavier tails than a Gaussian" in found["Tails of alpha_lab"].words
    assert "stretched exponential fits better" in found["Tails of alpha_lab"].words
    assert "not distinguishable from a Gaussian" in found["Tails of velocity"].words


@pytest.mark.slow
def test_attitudes_that_prefer_a_direction_are_reported(lab):
    assert verdicts_by_title(lab)["Orientations"].grade == "neutral"
    still = np.tile(np.eye(3), (len(lab), 1, 1))
    biased = replace(lab, orientation_smooth=np.where((lab.segment % 4 == 0)[:, None, None], still, lab.orientation))
    found = verdicts_by_title(biased)["Orientations"]
    assert found.grade == "doubt"
    assert found.words.startswith("not all orientations are equally likely")


@pytest.mark.slow
def test_noise_and_lost_frames_and_few_segments_are_marked(lab):
    rough = filtered_track(draw_ensemble(EnsembleSpec(segments=15, mean_frames=90.0), 5), 2.0, 0.05, 5)
    found = verdicts_by_title(replace(rough, valid=np.arange(len(rough)) % 2 == 0))
    assert found["Noise"].grade == "doubt"
    assert "is noise" in found["Noise"].words
    assert found["Measured"].grade == "doubt"
    assert "(50.04 %)" in found["Measured"].words
    assert found["Segments"].grade == "doubt"
    assert verdicts_by_title(lab)["Noise"].grade == "good"


@pytest.mark.slow
def test_remarks_of_the_run_are_repeated_once(lab):
    part = lab.at(np.arange(5000))
    marked = replace(part, provenance={"remarks": ["cam2 is a frame late"]})
    found = verdicts(summarise([marked, marked], FEW), {"a": marked, "b": marked}, [])
    (words,) = (verdict.words for verdict in found if verdict.title == "Remark")
    assert words.startswith("cam2 is a frame late; ")


def test_distances_are_reported_in_degrees(lab):
    part = lab.at(np.arange(5000))
    edges = np.linspace(0, 0.2, 11)
    one = CameraDistance(cameras=("a", "b"), distance_rad=np.full(9, 0.1), edges_rad=edges, pdf=np.ones(10),
                         uncorrected_rad=np.full(9, 0.2), uncorrected_pdf=np.ones(10))  # fmt: skip
    assert verdicts_by_title(part, [replace(one, distance_rad=np.full(9, 0.08))])["Cameras"].grade == "neutral"
    assert verdicts_by_title(part, [one])["Cameras"].grade == "doubt"
    words = verdicts_by_title(part, [one])["Cameras"].words
    assert "5.7°" in words
    assert "without correction of perspective by 11°" in words


def test_without_a_segment_that_counts_the_reason_is_reported(lab):
    short = lab.at(np.flatnonzero(lab.segment == np.bincount(lab.segment).argmax())[:30])
    found = verdicts_by_title(short)
    assert found["Segments"].grade == "doubt"
    assert "none has 50 frames with a motion" in found["Segments"].words
    assert "the longest has 30 frames" in found["Segments"].words
    assert "Noise" not in found


def test_a_track_that_nothing_smoothed_has_no_motion_to_report(lab):
    rates = ("velocity", "acceleration", "omega_lab", "alpha_lab")
    nothing = {name: np.full_like(getattr(lab, name), np.nan) for name in rates}
    found = verdicts_by_title(replace(lab, **nothing))
    assert "no motion: these poses were not smoothed" in found["Segments"].words


def test_rates_without_errors_are_named(lab):
    one = lab.at(np.flatnonzero(lab.segment == np.bincount(lab.segment).argmax()))
    found = verdicts_by_title(replace(one, omega_lab_sigma=one.omega_lab_sigma * np.nan))["Noise"]
    assert found.grade == "doubt"
    assert found.words.startswith("the errors of omega_lab are unknown")


def test_a_single_segment_gets_advice(lab):
    one = lab.at(np.flatnonzero(lab.segment == np.bincount(lab.segment).argmax()))
    found = verdicts_by_title(one)
    assert found["Segments"].grade == "doubt"
    assert "max_duration_s" in found["Segments"].words
    assert "Orientations" not in found
