"""Orientations without history: local normalisation, template banks, coarse to fine, the Proposer protocol."""

from sphereorient.search.candidates import Candidates
from sphereorient.search.crop import crop_disk
from sphereorient.search.extraction import extract_paint
from sphereorient.search.fallback import FallbackProposer
from sphereorient.search.grey_search import GreySearch
from sphereorient.search.proposer import Proposals, Proposer
from sphereorient.search.settings import GreySearchSettings, OrientSettings, ProposeSettings
from sphereorient.search.template_search import TemplateSearch

__all__ = [
    "Candidates",
    "FallbackProposer",
    "GreySearch",
    "GreySearchSettings",
    "OrientSettings",
    "Proposals",
    "ProposeSettings",
    "Proposer",
    "TemplateSearch",
    "crop_disk",
    "extract_paint",
]
