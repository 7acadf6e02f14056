"""One way through: run(method, store), parts that outlive a kill, workers, clusters."""

from sphereorient.run.drive import Outcome, track_experiments
from sphereorient.run.parts import Parts
from sphereorient.run.request import Request
from sphereorient.run.run import track_kept

__all__ = [
    "Outcome",
    "Parts",
    "Request",
    "track_experiments",
    "track_kept",
]
