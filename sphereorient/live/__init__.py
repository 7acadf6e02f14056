"""Live tracking: frames of a camera or another program in, poses out over sockets, frame by frame."""

from sphereorient.live.feed import Feed
from sphereorient.live.live import Measured, measured
