"""Which candidate is true: trellis, path, segments, two cameras; the path with physics."""

from sphereorient.assemble.path import Path, assemble_path, assemble_paths
from sphereorient.assemble.second_order import Chosen, Hypotheses, physical_path
from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.assemble.trellis import ShortestPath, edge_costs, shortest_path
from sphereorient.assemble.two_cameras import Fused, fuse

__all__ = [
    "AssembleSettings",
    "Chosen",
    "Fused",
    "Hypotheses",
    "Path",
    "PathSettings",
    "ShortestPath",
    "assemble_path",
    "assemble_paths",
    "edge_costs",
    "fuse",
    "physical_path",
    "shortest_path",
]
