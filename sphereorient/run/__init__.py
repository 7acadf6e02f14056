"""Run requests: run(request, store), stores to resume from, executors, many experiments."""

from sphereorient.run.many import Outcome, run_many
from sphereorient.run.stages import run, track_movies
from sphereorient.run.store import FolderStore, MemoryStore, Request
