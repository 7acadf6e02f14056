"""One way through: run(request, store), stores that outlive a kill, executors, many experiments."""

from sphereorient.run.many import Outcome, run_many
from sphereorient.run.stages import run, track_movies
from sphereorient.run.store import FolderStore, MemoryStore, Request
