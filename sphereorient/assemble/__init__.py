"""Which candidate is true: trellis, path, segments, two cameras."""

from sphereorient.assemble.path import Path, assemble_path, assemble_paths
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.assemble.trellis import ShortestPath, edge_costs, shortest_path
from sphereorient.assemble.two_cameras import Fused, fuse

__all__ = [
    "AssembleSettings",
    "Fused",
    "Path",
    "ShortestPath",
    "assemble_path",
    "assemble_paths",
    "edge_costs",
    "fuse",
    "shortest_path",
]
