"""One way through: run(request, store), stores that outlive a kill, executors, many experiments."""

from sphereorient.run.many import Outcome, run_many
from sphereorient.run.stages import run, track_movies
from sphereorient.run.store import FolderStore, MemoryStore, Request

__all__ = ["FolderStore", "MemoryStore", "Outcome", "Request", "run", "run_many", "track_movies"]
