"""Cameras that disagree, as after one was moved: each tracks the sphere alone, and all results are kept."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.poses import Poses, no_pose
from sphereorient.follow.settings import RefineSettings
from sphereorient.follow.tracker import ChunkTracker
from sphereorient.locate import Frame
from sphereorient.trajectory import Reason


class PerCameraTracker:
    """Tracks the sphere in each camera alone; the first that sees it gives the pose, the others contradict."""

    def __init__(self, appearance: Appearance, search: Initialiser, settings: RefineSettings) -> None:
        self.search = search
        count = len(appearance.fitter.views)
        self.trackers = [ChunkTracker(appearance.of(k), search, settings) for k in range(count)]

    def batches(self, frames: range) -> list[list[int]]:
        """Return the lengths of the chunks of each batch; see `ChunkTracker`."""
        return self.trackers[0].batches(frames)

    def track(self, shots: Sequence[Sequence[Frame]], batch: Sequence[int], time_s: Sequence[float]) -> Iterator[Poses]:
        """Track the chunks of one batch; see `ChunkTracker`."""
        each = [tracker.track([movie], batch, time_s) for tracker, movie in zip(self.trackers, shots, strict=True)]
        yield from (cameras_disagree(poses) for poses in zip(*each, strict=True))


def cameras_disagree(alone: Sequence[Poses]) -> Poses:
    """Return one frame's poses of the first of C cameras that sees the sphere, with the results of the others alone."""
    reasons = [poses.reason[0] for poses in alone]
    seeing = [k for k, poses in enumerate(alone) if len(poses) and bool(poses.use.any())]
    if not seeing:
        return no_pose(len(alone), [Reason.LOW_SCORE if why is Reason.OK else why for why in reasons])
    main = alone[seeing[0]]
    X, R = main.position_lab_mm, main.R_lab_body
    own = {name: _blank(getattr(main, name), len(alone)) for name in OWN}
    for k in seeing:
        own["own_turn"][:, k] = so3.log(alone[k].R_lab_body[:1] @ R.mT)
        own["own_move"][:, k] = alone[k].position_lab_mm[:1] - X
        for name in ("own_covariance", "deviation", "score"):
            own[name][:, k] = getattr(alone[k], name)[:1, 0]
    for name in ("own_covariance", "deviation", "score"):
        own[name][:, seeing[0]] = getattr(main, name)[:, 0]
    use = torch.zeros(len(alone), dtype=torch.bool)
    use[seeing[0]] = True
    reasons = [Reason.CONTRADICTS if k in seeing[1:] else why for k, why in enumerate(reasons)]
    return Poses(
        position_lab_mm=X,
        R_lab_body=R,
        covariance=main.covariance,
        nll=main.nll,
        step=main.step,
        use=use,
        reason=tuple(reasons),
        **own,
    )


OWN = ("own_turn", "own_covariance", "own_move", "deviation", "score")


def _blank(part: Tensor, cameras: int) -> Tensor:
    """Return zeros for all cameras where `part` (M, 1, ...) has one."""
    return part.new_zeros(part.shape[0], cameras, *part.shape[2:])
