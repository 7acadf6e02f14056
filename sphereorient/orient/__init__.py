"""Where could it point: extraction, bank, search, refinement; the Proposer protocol."""

from sphereorient.orient.apart import ApartTracker
from sphereorient.orient.blocks import BlockTracker
from sphereorient.orient.candidates import Candidates
from sphereorient.orient.cold import POSE_PARTS, Poses, cold_start
from sphereorient.orient.crop import crop_disk
from sphereorient.orient.doubt import DoubtProposer
from sphereorient.orient.extraction import extract_paint
from sphereorient.orient.eye import Eye, Fitter, Optics, base_table
from sphereorient.orient.gather import PoseTable, joined_tables, pose_table
from sphereorient.orient.grey_search import GreySearch
from sphereorient.orient.light import Light
from sphereorient.orient.pixels import LinesOfSight
from sphereorient.orient.proposer import Proposals, Proposer
from sphereorient.orient.refine import Fit, refine
from sphereorient.orient.search import TemplateSearch
from sphereorient.orient.settings import GreySearchSettings, OrientSettings, ProposeSettings, RefineSettings
from sphereorient.orient.softness import blur_seen_px, softness
from sphereorient.orient.study import Study, study

__all__ = [
    "POSE_PARTS",
    "ApartTracker",
    "BlockTracker",
    "Candidates",
    "DoubtProposer",
    "Eye",
    "Fit",
    "Fitter",
    "GreySearch",
    "GreySearchSettings",
    "Light",
    "LinesOfSight",
    "Optics",
    "OrientSettings",
    "PoseTable",
    "Poses",
    "Proposals",
    "ProposeSettings",
    "Proposer",
    "RefineSettings",
    "Study",
    "TemplateSearch",
    "base_table",
    "blur_seen_px",
    "cold_start",
    "crop_disk",
    "extract_paint",
    "joined_tables",
    "pose_table",
    "refine",
    "softness",
    "study",
]
