from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from statistics_examples import track

from sphereorient.statistics.cameras import camera_distances
from sphereorient.trajectory import CameraTrack


def seen(R: np.ndarray) -> CameraTrack:
    return replace(CameraTrack.empty(len(R)), orientation=R)


def test_distances_of_two_cameras_are_the_planted_angles():
    whole = track([60])
    rng = np.random.default_rng(5)
    first = Rotation.random(len(whole), rng)
    angle = rng.uniform(1e-6, np.pi - 1e-3, len(whole))
    axis = rng.standard_normal((len(whole), 3))
    second = first * Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    A, B = first.as_matrix(), second.as_matrix()
    A[3] = np.nan
    (found,) = camera_distances(replace(whole, cameras={"cam2": seen(B), "cam1": seen(A)}))
    np.testing.assert_allclose(found.distance_rad, np.delete(angle, 3), atol=1e-6)
    assert found.cameras == ("cam1", "cam2")
    assert (found.pdf * np.diff(found.edges_rad)).sum() == pytest.approx(1)
    assert found.uncorrected_rad is None


def test_distances_without_the_correction_come_beside_where_given():
    whole = track([60])
    unit = np.tile(np.eye(3), (len(whole), 1, 1))
    turned = Rotation.from_rotvec([0.2, 0, 0]).as_matrix() @ unit
    both = replace(whole, cameras={"a": seen(unit), "b": seen(unit)})
    (found,) = camera_distances(both, [{"a": unit, "b": turned}])
    assert np.median(found.distance_rad) == pytest.approx(0)
    np.testing.assert_allclose(found.uncorrected_rad, 0.2)


def test_one_camera_has_no_distance():
    assert camera_distances(replace(track([60]), cameras={"a": CameraTrack.empty(62)})) == []


def test_distances_of_many_tracks_are_pooled_by_the_names_of_the_cameras():
    unit, turned = (np.tile(Rotation.from_rotvec([0, 0, x]).as_matrix(), (62, 1, 1)) for x in (0.0, 0.2))
    two = {name: replace(CameraTrack.empty(62), orientation=R) for name, R in (("a", unit), ("b", turned))}
    one = replace(track([60]), cameras=two)
    (found,) = camera_distances([one, one, replace(track([60]), cameras={})], [None, {"a": unit, "b": unit}])
    assert len(found.distance_rad) == 124
    assert np.median(found.distance_rad) == pytest.approx(0.2)
    assert len(found.uncorrected_rad) == 62
    assert found.uncorrected_rad.max() == 0.0
