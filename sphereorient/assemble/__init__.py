"""Which candidate is true: trellis, path, segments, two cameras; the path with physics; the soft paths."""

from sphereorient.assemble.path import Path, assemble_path, assemble_paths
from sphereorient.assemble.path_weights import Frames, PathWeights, Weights
from sphereorient.assemble.second_order import Chosen, Hypotheses, physical_path
from sphereorient.assemble.second_order_layer import shortest_path_of_pairs, soft_path_of_pairs
from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.assemble.soft_path import SoftPath, expected_orientation, soft_path
from sphereorient.assemble.trellis import ShortestPath, edge_costs, shortest_path
from sphereorient.assemble.two_cameras import Fused, fuse

__all__ = [
    "AssembleSettings",
    "Chosen",
    "Frames",
    "Fused",
    "Hypotheses",
    "Path",
    "PathSettings",
    "PathWeights",
    "ShortestPath",
    "SoftPath",
    "Weights",
    "assemble_path",
    "assemble_paths",
    "edge_costs",
    "expected_orientation",
    "fuse",
    "physical_path",
    "shortest_path",
    "shortest_path_of_pairs",
    "soft_path",
    "soft_path_of_pairs",
]
