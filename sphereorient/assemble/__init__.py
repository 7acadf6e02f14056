"""The choice among candidates along time: the paper's path and two cameras; the second-order path; both as a layer."""

from sphereorient.assemble.layer import PathLayer, SoftTrack, expected_orientation, soft_track
from sphereorient.assemble.second_order import Chosen
from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.assemble.trellis import ShortestPath, SoftPath, edge_costs, shortest_path, soft_path
from sphereorient.assemble.two_cameras import Fused, Path, assemble_path, assemble_paths, fuse
