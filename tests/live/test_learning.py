"""Without a map at the start: orientations from the first frame on, while place and map are adjusted."""

import math
import time

import pytest
import torch
from renders import error_deg
from turning_examples import RATE_HZ, turning_ball  # noqa: F401

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.live.learning import LearningTracker
from sphereorient.pose.poses import supported


def followed(tracker: LearningTracker, ball, numbers, wait: int = -1):
    """Orientations (N, 3, 3), the numbers of the maps, and lasting errors as stated, degrees; at frame `wait` until
    there is another map.
    """
    R, maps, lasting = [], [], []
    for k in numbers:
        ((poses, searched),) = tracker.next(k / RATE_HZ, [ball.frames[k]]).values()
        assert searched == (k == 0), k
        assert supported(poses)
        R.append(poses.R_lab_body[0])
        maps.append(tracker.number)
        variance = tracker.appearances[""].lasting.covariance[:3, :3].trace()
        lasting.append(math.degrees(math.sqrt(float(variance))))
        until = time.monotonic() + 60
        tracker.between()
        while k == wait and tracker.number == maps[-1] and time.monotonic() < until:
            time.sleep(0.05)
            tracker.between()
    return torch.stack(R), maps, torch.tensor(lasting)


@pytest.mark.slow
def test_an_adjustment_takes_drift_away_and_the_body_frame_goes_on(ball):
    tracker = LearningTracker(ball.place)
    R, maps, lasting_deg = followed(tracker, ball, range(70), wait=50)
    tracker.close()
    assert maps[:25] == [1] * 25
    assert maps[51] > maps[50]
    assert error_deg(R[:1], torch.eye(3, dtype=torch.float64)[None]).max() < 0.1
    off_deg = torch.rad2deg(so3.geodesic_distance(R, ball.R[:70] @ ball.R[0].mT))  # the first frame is the zero
    assert (off_deg < 2.5 * lasting_deg + 0.2).all()
    assert lasting_deg[51] < 0.7 * lasting_deg[50]
    assert off_deg[51:].max() < 0.5 * off_deg[50]
    steps = error_deg(R[1:] @ R[:-1].mT, ball.R[1:] @ ball.R[:-1].mT)
    assert steps[:50].median() < 0.2
    assert steps[51:].median() < 0.15
    body = so3.nearest_rotation((R[51:].mT @ ball.R[51:]).mean(0))
    assert error_deg(R[51:] @ body, ball.R[51:]).median() < 0.4


@pytest.mark.slow
def test_the_map_of_the_frames_so_far_shows_the_paint(ball):
    tracker = LearningTracker(ball.place)
    followed(tracker, ball, range(3))
    with pytest.raises(PaintError, match="rotates"):
        tracker.texture()
    followed(tracker, ball, range(3, 40))
    found = tracker.texture()
    tracker.close()
    assert found.unseen is not None
    assert 0.3 < float((~found.unseen).double().mean()) < 1.0
    assert float(found.grey[~found.unseen].std()) > 0.2
