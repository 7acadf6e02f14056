"""A trained network as proposer: the pipeline measures as well as with the template search."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import REPO
from excerpt_examples import EXCERPT, shortened
from typer.testing import CliRunner

from sphereorient import track_movies
from sphereorient.bench import score_track
from sphereorient.cli.app import app
from sphereorient.errors import CheckpointError, ShapeError
from sphereorient.files.provenance import sha256
from sphereorient.learn.checkpoint import correlator_of, load_checkpoint
from sphereorient.learn.network import DEFAULT_CHECKPOINT, LearnedProposer, probability_of
from sphereorient.learn.pictures import film
from sphereorient.learn.settings import PictureSettings
from sphereorient.methods.proposers import paper_proposer, precise_proposer
from sphereorient.methods.settings import Settings, load_settings
from sphereorient.search import FallbackProposer, GreySearch
from sphereorient.so3 import geodesic_distance, random_rotations
from sphereorient.synth import random_texture
from sphereorient.trajectory import Reason, Trajectory

SHARED = REPO.parent / "shared" / "experiment"  # skipped where it is absent


@pytest.fixture(scope="module")
def texture() -> torch.Tensor:
    return random_texture("patches", 987_654, 128)


@pytest.fixture(scope="module")
def network(texture: torch.Tensor) -> LearnedProposer:
    kept = load_checkpoint(DEFAULT_CHECKPOINT)
    return LearnedProposer(correlator_of(kept), texture, temperature=kept.temperature)


@pytest.fixture(scope="module")
def filmed(texture: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(3)
    R = random_rotations(48, generator=rng)
    return film(texture, R.float(), {"read_noise": 6.0}, rng, PictureSettings()), R


def check_excerpt(track: Trajectory, median_deg: float, proposer: Path) -> None:
    score = score_track(track, EXCERPT / "truth.h5")
    assert score.valid.all()
    assert np.median(score.orientation_deg) < median_deg
    assert score.orientation_deg.max() < 10
    assert track.provenance["proposer_sha256"] == sha256(proposer)


@pytest.mark.slow
def test_the_paper_tracks_the_excerpt_with_the_network(tmp_path: Path) -> None:
    alone = load_settings(None, ["propose.when=always", "propose.checkpoint=default"])
    experiment = shortened(tmp_path / "copy", 0, 12)
    track = track_movies(experiment, method="paper", settings=alone)
    check_excerpt(track, 4.0, DEFAULT_CHECKPOINT)
    assert "checkpoint: default" in track.settings


@pytest.mark.slow
def test_the_command_line_takes_a_checkpoint(tmp_path: Path) -> None:
    own, out = tmp_path / "own.ckpt", tmp_path / "track.h5"
    shutil.copy(DEFAULT_CHECKPOINT, own)
    words = ["--out", str(out), "--proposer", str(own), "--set", "propose.when=always", "--quiet"]
    run = CliRunner().invoke(app, ["track", str(shortened(tmp_path / "copy", 0, 12)), *words])
    assert run.exit_code == 0, run.output
    check_excerpt(Trajectory.load(out), 0.08, own)


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize("when", ["in_doubt", "always"])
def test_the_precise_figures_hold_with_the_network(when: str) -> None:
    settings = load_settings(None, [f"propose.when={when}", "propose.checkpoint=default"])
    track = track_movies(SHARED / "experiment.yaml", settings=settings)
    score = score_track(track, SHARED / "truth.h5")
    p50, p95, _, worst = score.percentiles_deg()
    assert score.valid.all()
    assert p50 < 0.06
    assert p95 < 0.12
    assert worst < 0.3


def test_the_right_orientation_comes_first(network: LearnedProposer, filmed: tuple[torch.Tensor, torch.Tensor]) -> None:
    disks, R = filmed
    found = network.propose(disks)
    first = found.offset[:-1]
    assert (found.offset.diff() > 0).all()
    off = torch.rad2deg(geodesic_distance(found.R_view_body[first], R))
    assert off.median() < 4
    assert (off < 10).float().mean() > 0.95
    probability = probability_of(found.score)
    assert ((probability > 0) & (probability <= 1 + 1e-6)).all()
    for f in range(len(disks)):
        own = probability[found.offset[f] : found.offset[f + 1]]
        assert (own.diff() <= 0).all()
        assert own.sum() <= 1 + 1e-6


@pytest.mark.slow
def test_a_mirrored_map_is_no_match(
    texture: torch.Tensor, filmed: tuple[torch.Tensor, torch.Tensor], network: LearnedProposer
) -> None:
    kept = load_checkpoint(DEFAULT_CHECKPOINT)
    mirrored = LearnedProposer(correlator_of(kept), texture.flip(1), temperature=kept.temperature)
    disks, _ = filmed
    right, wrong = network.propose(disks), mirrored.propose(disks)
    doubtful, sure = (probability_of(each.score[each.offset[:-1]]).median() for each in (wrong, right))
    assert doubtful < sure - 0.1


def test_answers_do_not_depend_on_company_or_on_the_scale_of_grey(
    network: LearnedProposer, filmed: tuple[torch.Tensor, torch.Tensor]
) -> None:
    disks, _ = filmed
    together = network.propose(disks)
    alone = [network.propose(disks[f : f + 1]) for f in (0, 17, 47)]
    for f, own in zip((0, 17, 47), alone, strict=True):
        rows = slice(int(together.offset[f]), int(together.offset[f + 1]))
        assert torch.equal(own.R_view_body, together.R_view_body[rows])
        assert torch.equal(own.score, together.score[rows])
    brighter = network.propose(disks[:4] * 3 + 20)
    first = network.propose(disks[:4])
    assert geodesic_distance(
        brighter.R_view_body[brighter.offset[:-1]], first.R_view_body[first.offset[:-1]]
    ).max() < np.deg2rad(1)


def test_disks_that_show_nothing_have_no_proposal(network: LearnedProposer) -> None:
    size = network.size_px
    found = network.propose(torch.full((2, size, size), 17.0))
    assert found.offset.tolist() == [0, 0, 0]
    assert found.reason == (Reason.LOW_SCORE,) * 2
    assert len(network.propose(torch.zeros(0, size, size)).reason) == 0
    with pytest.raises(ShapeError):
        network.propose(torch.zeros(1, size, size + 1))


@pytest.mark.slow
def test_settings_choose_who_proposes(texture: torch.Tensor) -> None:
    alone = load_settings(None, ["propose.checkpoint=default", "propose.when=always"])
    assert isinstance(precise_proposer(texture, Settings()), GreySearch)
    assert isinstance(precise_proposer(texture, alone), LearnedProposer)
    assert isinstance(paper_proposer(texture, 60, alone), LearnedProposer)
    both = load_settings(None, ["propose.checkpoint=default"])
    assert isinstance(precise_proposer(texture, both), FallbackProposer)
    assert isinstance(paper_proposer(texture, 60, both), FallbackProposer)


@pytest.mark.slow
@pytest.mark.parametrize("content", [None, b"nothing of the kind"])
def test_a_checkpoint_that_is_none_is_one_line(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "other.ckpt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        track_movies(EXCERPT / "experiment.yaml", settings=load_settings(None, [f"propose.checkpoint={path}"]))
    assert "\n" not in str(caught.value)
    assert "other.ckpt" in str(caught.value)
