from conftest import REPO

from sphereorient.movies.hdf5 import TIMES
from sphereorient.movies.movie import FLIPS
from sphereorient.movies.open import READERS
from sphereorient.movies.sequence import PICTURES
from sphereorient.movies.write import WRITERS

TEXT = (REPO / "docs" / "movies.md").read_text()
NAMED = {".ppm": "PPM", ".pgm": "PGM", ".bmp": "BMP", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def test_every_suffix_flip_and_name_of_times_is_on_the_page():
    for suffix in {*READERS, *WRITERS}:
        assert f"{suffix}`" in TEXT, suffix
    for suffix in PICTURES:
        assert NAMED.get(suffix, "TIFF") in TEXT, suffix
    for name in TIMES:
        assert f"`{name}`" in TEXT, name
    for how in FLIPS:
        assert how in TEXT, how
