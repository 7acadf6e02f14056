"""Movies: one reader interface, one file per format, exact grey values."""

from sphereorient.movies.movie import Movie
from sphereorient.movies.npy import NpyMovie
from sphereorient.movies.open import open_movie
from sphereorient.movies.video import VideoMovie
from sphereorient.movies.write import write_ffv1

__all__ = ["Movie", "NpyMovie", "VideoMovie", "open_movie", "write_ffv1"]
