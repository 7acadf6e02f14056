"""Movies: one reader interface, one file per format, exact grey values."""

from sphereorient.movies.movie import Grey, Movie, flipped, flipped_picture, flipped_shape
from sphereorient.movies.open import is_movie, movie_files, open_movie
from sphereorient.movies.write import write_ffv1, write_movie
