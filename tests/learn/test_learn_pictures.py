"""Pictures to learn from: the same for the same numbers, other ones for others, right answers beside them."""

from __future__ import annotations

import math
from types import SimpleNamespace

import cv2
import pytest
import torch
from conftest import assert_close
from learn_examples import tiny

from sphereorient.errors import SettingsError
from sphereorient.learn import pictures as module
from sphereorient.learn.metrics import BENCHMARK_SEED, MAPS, clean_views
from sphereorient.learn.pictures import VALIDATION_SEED, draw_batch, draw_values, generator_of, make_textures, value_at
from sphereorient.learn.settings import PictureSettings, ProposerSettings
from sphereorient.learn.train import TrainingData
from sphereorient.synth import random_texture
from sphereorient.synth.disks import DISK_DEGRADATIONS
from sphereorient.synth.severities import DEGRADATIONS

SETTINGS = tiny().pictures
NODES = tiny().network.nodes
SHAPE = (2, 3, 4)


@pytest.fixture(scope="module")
def balls():
    return make_textures(SETTINGS, NODES, count=6, first_seed=0)


@pytest.fixture(scope="module")
def data():
    return TrainingData(tiny())


def test_the_same_numbers_give_the_same_lesson_and_others_another(data):
    first, again = data.training_batch(3, 5), data.training_batch(3, 5)
    assert torch.equal(first.disks, again.disks)
    assert torch.equal(first.R_view_body, again.R_view_body)
    assert torch.equal(first.blurs, again.blurs)
    # epoch 3, step 5 is neither epoch 5, step 3 nor a neighbour of the same sum
    for epoch, step in ((5, 3), (4, 4), (3, 6), (0, 0)):
        assert not torch.equal(data.training_batch(epoch, step).R_view_body, first.R_view_body)


@pytest.mark.slow
def test_each_epoch_has_pictures_of_its_own():
    data = TrainingData(tiny())
    for epoch in (0, 2):
        data.trainer = SimpleNamespace(current_epoch=epoch)
        lessons = list(data.train_dataloader())
        assert len(lessons) == tiny().training.steps
        assert torch.equal(lessons[3].disks, data.training_batch(epoch, 3).disks)


@pytest.mark.slow
def test_another_data_module_of_the_same_settings_gives_the_same_pictures(data):
    other = TrainingData(tiny())
    assert torch.equal(other.training_batch(1, 2).disks, data.training_batch(1, 2).disks)
    assert torch.equal(other.validation[0].disks, data.validation[0].disks)
    seeded = TrainingData(tiny(seed=1))
    assert not torch.equal(seeded.training_batch(1, 2).disks, data.training_batch(1, 2).disks)


def test_generators_of_different_numbers_are_different():
    firsts = {
        int(torch.randint(1 << 60, (), generator=generator_of(*numbers)))
        for numbers in [(0,), (1,), (0, 0), (0, 1), (1, 0), (0, 0, 1), (0, 1, 0), (1, 1), (2,), (1 << 40,), (1 << 41,)]
    }
    assert len(firsts) == 11


def test_no_map_of_the_validation_or_of_the_trial_is_one_of_the_training(monkeypatch):
    """Every seed that a map is made of, also those of mixed kinds, for the largest counts that are used."""
    texture = torch.zeros(SETTINGS.texture_rows, 2 * SETTINGS.texture_rows)
    monkeypatch.setattr(module, "map_blurs", lambda textures, side: torch.zeros(len(textures), 1, 1))
    kinds = SETTINGS.model_copy(update={"kinds": ("blobs", "dots")})

    def seeds_of(first: int, count: int) -> set[int]:
        asked: set[int] = set()

        def noted(kind: str, seed: int, height: int) -> torch.Tensor:
            asked.add(seed)
            return texture

        monkeypatch.setattr(module, "random_texture", noted)
        make_textures(kinds, NODES, count=count, first_seed=first)
        return asked

    training, validation, trial = seeds_of(0, 4000), seeds_of(VALIDATION_SEED, MAPS), seeds_of(BENCHMARK_SEED, MAPS)
    assert len(training) >= 4000
    assert not training & validation
    assert not training & trial
    assert not validation & trial


def test_there_are_as_many_validation_pictures_as_in_the_settings(data):
    assert sum(lesson.disks.shape[0] * lesson.disks.shape[1] for lesson in data.validation) == SETTINGS.validation


@pytest.mark.slow
def test_validation_pictures_are_not_those_of_the_training(data):
    lessons = data.validation
    assert not any(
        torch.equal(one.R_view_body[0, :4], data.training_batch(0, k).R_view_body[0, :4])
        for k in range(5)
        for one in lessons
    )


def test_a_lesson_has_its_stated_shapes(balls):
    lesson = draw_batch(balls, SETTINGS, generator_of(1), SHAPE)
    assert lesson.blurs.shape[:2] == (2, NODES * NODES)
    assert lesson.disks.shape == (2, 12, 24, 24)
    assert lesson.R_view_body.shape == (2, 12, 3, 3)
    assert_close(torch.linalg.det(lesson.R_view_body), torch.ones(2, 12), atol=1e-5)


def test_pictures_show_the_map_of_the_blurs_at_the_answers_orientation(balls):
    """Without degradations a disk looks like the clean view of its answer, negative or not; not like another's."""
    plain = SETTINGS.model_copy(update={"at_once": 0})
    negatives = 0
    for seed in range(8):
        lesson = draw_batch(balls, plain, generator_of(seed), (1, 1, 4))
        near = (balls.blurs - lesson.blurs[0]).abs().amax((1, 2)).min()
        negatives += bool(near > 0.1)
        whole = torch.cat([balls.blurs, -balls.blurs])
        k = int((whole - lesson.blurs[0]).abs().amax((1, 2)).argmin())
        texture = balls.textures[k % 6] if k < 6 else 1 - balls.textures[k % 6]
        views = clean_views(texture, lesson.R_view_body[0], 24)
        inside = views[0].isfinite()
        shown = torch.stack([disk[inside] for disk in lesson.disks[0]])
        like = torch.corrcoef(torch.cat([shown, torch.stack([view[inside] for view in views])]))[:4, 4:]
        assert (like.diagonal() > 0.6).all()
        assert torch.equal(like.argmax(1), torch.arange(4))
    assert 0 < negatives < 8


@pytest.mark.parametrize("name", DISK_DEGRADATIONS)
def test_values_between_levels_are_between_those_of_the_levels(name):
    values = DEGRADATIONS[name].values
    for level in (1, 2, 3, 4, 5):
        assert math.isclose(value_at(name, float(level)), values[level - 1], rel_tol=1e-9)
    half = value_at(name, 3.5)
    assert min(values[2], values[3]) < half < max(values[2], values[3])
    assert math.isclose(half * half, values[2] * values[3], rel_tol=1e-9)
    DEGRADATIONS[name].check(value_at(name, 4.999))


def test_values_are_drawn_from_the_ranges_of_the_settings():
    settings = PictureSettings(at_once=2, hardest=3.0)
    drawn = [draw_values(settings, generator_of(k)) for k in range(400)]
    counts = [sum(len(values) == count for values in drawn) for count in range(4)]
    assert counts[3] == 0
    assert min(counts[:3]) > 80  # of 133
    assert {name for values in drawn for name in values} == set(DISK_DEGRADATIONS)
    for values in drawn:
        for name, value in values.items():
            low, high = sorted((DEGRADATIONS[name].values[0], DEGRADATIONS[name].values[2]))
            assert low <= value <= high


def test_one_map_alone_is_learnt_as_it_is_in_the_file(tmp_path):
    path = tmp_path / "texture.png"
    grey = (255 * random_texture("dots", 4, 128)).round().to(torch.uint8)
    cv2.imwrite(str(path), grey.numpy())
    own = SETTINGS.model_copy(update={"texture": str(path), "at_once": 0})
    balls = make_textures(own, NODES, count=5, first_seed=0)
    assert balls.textures.shape == (1, 48, 96)
    assert_close(balls.textures.mean(), grey.float().mean() / 255, atol=1e-3)
    for seed in range(6):  # never in negative: that would be another ball
        assert torch.equal(draw_batch(balls, own, generator_of(seed), SHAPE).blurs[0], balls.blurs[0])


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"pictures": {"kinds": ["blob"]}}, "blobs"),
        ({"pictures": {"kinds": []}}, "kinds"),
        ({"pictures": {"degradations": ["spin"]}}, "degradations"),
        ({"network": {"size_px": 32}}, "size_px"),
    ],
)
def test_impossible_settings_are_refused(change, word):
    with pytest.raises((SettingsError, ValueError), match=word):
        ProposerSettings.model_validate(change)
