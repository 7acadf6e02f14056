"""Where could it point: extraction, bank, search; the Proposer protocol."""

from sphereorient.orient.candidates import Candidates
from sphereorient.orient.crop import crop_disk
from sphereorient.orient.extraction import extract_paint
from sphereorient.orient.proposer import Proposals, Proposer
from sphereorient.orient.search import TemplateSearch
from sphereorient.orient.settings import OrientSettings

__all__ = [
    "Candidates",
    "OrientSettings",
    "Proposals",
    "Proposer",
    "TemplateSearch",
    "crop_disk",
    "extract_paint",
]
