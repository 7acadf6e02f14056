"""Where a ball stands whose rim tells nothing: black paint before a dark scene hides half of it."""

from __future__ import annotations

import torch

from sphereorient.locate import LocateSettings
from sphereorient.locate.blob import find_blobs
from sphereorient.locate.find import Found
from sphereorient.locate.outline import Outline
from sphereorient.pose.fitter import CameraView, Picture
from sphereorient.search.crop import crop_disk
from sphereorient.search.proposer import Proposer
from sphereorient.trajectory import Reason

STEP, REACH = 0.2, 2  # of the radius, from place to place; places to each side of the blob's middle
LOOSE = 0.15  # of the radius: how far off the best place may be


def relocalise(frame: Picture, view: CameraView, proposer: Proposer, locating: LocateSettings) -> Found:
    """Find the place about a blob where the map explains a disk of the usual size best.

    Args:
        frame: (H, W), grey levels.
        view: the camera.
        proposer: whose scores tell how well the map explains a disk.
        locating: how blobs are found.

    Returns:
        An outline that nobody saw, with a wide scatter, or None where there is no blob.
    """
    difference = view.background.difference(frame)
    blobs = find_blobs(difference, view.background.noise, view.diameter_px, locating)
    if not blobs:
        return None, Reason.NOT_FOUND
    radius = view.diameter_px / 2
    steps = [STEP * radius * k for k in range(-REACH, REACH + 1)]
    places = [(blobs[0].u_px + right, blobs[0].v_px + down) for down in steps for right in steps]
    disks = [torch.from_numpy(crop_disk(frame, u, v, radius, proposer.size_px)) for u, v in places]
    proposals = proposer.propose(torch.stack(disks))
    if not len(proposals.score):
        return None, Reason.LOW_SCORE
    best = int(torch.searchsorted(proposals.offset, int(proposals.score.argmax()), right=True)) - 1
    u, v = places[best]
    return Outline(u_px=u, v_px=v, radius_px=radius, rms_px=LOOSE * radius, coverage=0.0), Reason.OK
