"""Several balls cut out of movies before there are maps, by their positions."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sphereorient import so3
from sphereorient.cameras import sphere_disk_px
from sphereorient.errors import PaintError
from sphereorient.locate import CameraScene
from sphereorient.locate.outline import Outline
from sphereorient.locate.position import assigned
from sphereorient.mapping.balls import (
    FARTHEST,
    FREE,
    crops_of_ball,
    linked_matches,
    linked_places,
    matched_instant,
    nearest_texels,
)
from sphereorient.mapping.disks import Crop
from sphereorient.pose.camera_view import CameraView
from sphereorient.sphere.compare import turned_map
from sphereorient.sphere.texture import random_texture
from sphereorient.synth import SynthSettings
from sphereorient.synth.write import default_cameras

FRAMES, RADIUS_MM, NOISE_PX = 40, 7.0, 0.4
NAMES = ("a", "b", "c")
SIZE = SynthSettings(image_size=(260, 260), diameter_px=52.0, diameter_mm=14.0, distance_mm=520.0, cameras=3)


class Chosen:
    """A match of disks, by index."""

    def __init__(self, *chosen: int) -> None:
        self.chosen = chosen

    def shares(self, other: Chosen) -> bool:
        return any(k == m >= 0 for k, m in zip(self.chosen, other.chosen, strict=True))


def test_no_disk_is_in_two_balls_and_a_ball_that_fits_nowhere_is_not_seen():
    matches = [Chosen(0, 0), Chosen(1, 0), Chosen(1, 1)]
    cost = np.array([[0.5, 3.0, 50.0], [4.0, 0.2, 1.0]])
    assert assigned(cost - FARTHEST, matches) == [(0, 0), (1, 2)], "the second one's best match has a disk of the first"
    cost[1] = 5.0, 5.0, 30.0
    assert assigned(cost - FARTHEST, matches) == [(0, 0)]


def paths() -> dict[str, torch.Tensor]:
    """Balls that pass before each other, (N, 3) each, mm."""
    t = torch.linspace(-0.5, 0.5, FRAMES, dtype=torch.float64)[:, None]
    begin = {"a": [2.0, -12.0, 3.0], "b": [-2.0, 8.0, 1.0], "c": [3.0, 14.0, -14.0]}
    way = {"a": [30.0, 3.0, 0.0], "b": [-24.0, 0.0, -5.0], "c": [5.0, 3.0, 10.0]}
    return {name: torch.tensor([begin[name]]).double() + t * torch.tensor([way[name]]).double() for name in NAMES}


@pytest.fixture(scope="module")
def seen():
    """Disks of all cameras, in any order, less those that are hidden and some that are missed; with false ones."""
    cameras, rng = default_cameras(SIZE), np.random.default_rng(0)
    background = SimpleNamespace(mean=np.zeros((260, 260), np.float32))
    views = [
        CameraView.of(name, camera, CameraScene(background=background, diameter_px=52.0))
        for name, camera in cameras.items()
    ]
    found = paths()
    disk = {
        (name, c): [part.numpy() for part in sphere_disk_px(view.camera, found[name], RADIUS_MM)]
        for name in NAMES
        for c, view in enumerate(views)
    }
    instants = []
    for k in range(FRAMES):
        disks = []
        for c in range(len(views)):
            own = []
            for name in NAMES:
                middle, radius = disk[name, c][0][k], float(disk[name, c][1][k])
                away = [np.linalg.norm(middle - disk[other, c][0][k]) for other in NAMES if other != name]
                if min(away) < 0.5 * radius or rng.random() < 0.05:
                    continue
                u, v = middle + NOISE_PX * rng.standard_normal(2)
                own.append(Outline(u_px=u, v_px=v, radius_px=radius, rms_px=2 * NOISE_PX, coverage=1.0))
            if rng.random() < 0.2:
                u, v = rng.uniform(30, 230, 2)
                own.append(Outline(u_px=u, v_px=v, radius_px=26.0, rms_px=2 * NOISE_PX, coverage=0.3))
            disks.append([own[n] for n in rng.permutation(len(own))])
        crops = [[Crop(grey=np.full((2, 2), n), top=0, left=0) for n in range(len(row))] for row in disks]
        instants.append(matched_instant(disks, crops, cameras, 2 * RADIUS_MM))
    scenes = [dict.fromkeys(NAMES, SimpleNamespace(diameter_px=52.0)) for _ in views]
    return instants, scenes, views


def test_each_ball_stays_the_same_one_though_they_pass_before_each_other(seen):
    instants, scenes, _ = seen
    chosen = linked_matches(instants, scenes, dict.fromkeys(NAMES, RADIUS_MM))
    taken = set()
    for n in range(len(NAMES)):
        X = linked_places(chosen[:, n], instants)
        away = {name: np.linalg.norm(X - path.numpy(), axis=1) for name, path in paths().items()}
        here = min(away, key=lambda name, far=away: float(np.median(far[name])))
        taken.add(here)
        assert (chosen[:, n] >= 0).mean() > 0.9
        assert away[here].max() < 0.2 * RADIUS_MM
    assert taken == set(NAMES)


def test_a_disk_that_another_one_touches_is_not_used_though_that_one_is_not_seen(seen):
    instants, scenes, views = seen
    radii = dict.fromkeys(NAMES, RADIUS_MM)
    chosen = linked_matches(instants, scenes, radii)
    places = [linked_places(chosen[:, n], instants) for n in range(3)]
    touched = 0
    for n, name in enumerate(NAMES):
        order = [places[n], *(place for m, place in enumerate(places) if m != n)]
        found = crops_of_ball(name, chosen[:, n], instants, views, radii, order)
        for c, view in enumerate(views):
            middle, radius = (
                torch.stack(parts)
                for parts in zip(
                    *(sphere_disk_px(view.camera, torch.from_numpy(X), RADIUS_MM) for X in order), strict=True
                )
            )
            near = ((middle[0] - middle[1:]).norm(dim=-1) < 0.98 * FREE * (radius[0] + radius[1:])).any(0)
            touched += int(near.sum())
            assert not bool((found.seen[:, c] & near).any())
            assert all(
                (crop is not None) == bool(there) for crop, there in zip(found.crops[c], found.seen[:, c], strict=True)
            )
        assert int(found.seen.any(1).sum()) > FRAMES // 2
    assert touched > 20


def test_more_balls_named_than_seen_are_reported(seen):
    instants, scenes, _ = seen
    six = [dict.fromkeys("abcdef", one["a"]) for one in scenes]
    with pytest.raises(PaintError, match="6 balls"):
        linked_matches(instants, six, dict.fromkeys("abcdef", RADIUS_MM))


def test_counts_follow_the_frame_as_the_paint_does():
    paint, turn = random_texture("dots", 3, 128), so3.exp(torch.tensor([1.2, -2.0, 0.4], dtype=torch.float64))
    turned = nearest_texels((paint > 0.5).long() * 7, turn, 128)
    there = turned_map(paint, turn)
    clear = (there - 0.5).abs() > 0.45
    assert torch.equal(turned[clear], (there[clear] > 0.5).long() * 7)
    assert set(turned.unique().tolist()) <= {0, 7}, "counts are not averaged"
