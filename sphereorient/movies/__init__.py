"""Movies: one reader interface, one file per format, exact grey values."""

from sphereorient.movies.ffv1 import write_ffv1
from sphereorient.movies.flipped import flipped, flipped_picture
from sphereorient.movies.movie import Grey, Movie
from sphereorient.movies.open import movie_files, open_movie
from sphereorient.movies.readable import readable
from sphereorient.movies.write import write_movie

__all__ = [
    "Grey",
    "Movie",
    "flipped",
    "flipped_picture",
    "movie_files",
    "open_movie",
    "readable",
    "write_ffv1",
    "write_movie",
]
