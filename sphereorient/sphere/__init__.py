"""The painted sphere: its map, how it looks, and the canonical view."""

from sphereorient.sphere.renderer import DirectionTable, SphereRenderer
from sphereorient.sphere.texture import load_texture, reduced_texture, sample_texture
from sphereorient.sphere.view import DiskView, orthographic_view, perspective_view, sphere_normals

__all__ = [
    "DirectionTable",
    "DiskView",
    "SphereRenderer",
    "load_texture",
    "orthographic_view",
    "perspective_view",
    "reduced_texture",
    "sample_texture",
    "sphere_normals",
]
