"""Frames in which a ball may be another one are marked."""

import numpy as np

from sphereorient.methods.results import with_identity
from sphereorient.trajectory import Flag, Trajectory


def test_a_name_of_low_probability_is_doubtful_and_one_without_probability_is_not():
    certain = np.array([np.nan, 1.0, 0.995, 0.98, 0.5])
    track = Trajectory.empty(np.arange(5) / 600.0)
    track.flags[4] = Flag.SPIKE
    found = with_identity(track, certain)
    np.testing.assert_array_equal(found.identity, certain)
    assert found.flags.tolist() == [0, 0, 0, Flag.IDENTITY, Flag.IDENTITY | Flag.SPIKE]
