"""Long runs: parts that are kept, resuming, worker processes, many experiments, clusters."""

from sphereorient.jobs.drive import Outcome, track_experiments
from sphereorient.jobs.parts import Parts
from sphereorient.jobs.request import Request
from sphereorient.jobs.run import track_kept

__all__ = ["Outcome", "Parts", "Request", "track_experiments", "track_kept"]
