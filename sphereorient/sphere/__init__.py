"""The painted sphere: its map, its views, and the renderer."""

from sphereorient.sphere.renderer import Sampling, SphereRenderer, see_sphere
from sphereorient.sphere.texture import (
    load_known,
    load_texture,
    load_unseen,
    read_seen,
    reduced_texture,
    sample_texture,
    seen_path,
    unseen_share,
)
from sphereorient.sphere.texture_table import DirectionTable
from sphereorient.sphere.view import DiskView, orthographic_view, perspective_view, sphere_normals
