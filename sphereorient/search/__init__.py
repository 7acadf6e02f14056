"""Search for the orientation without history: normalisation, template banks, coarse to fine, candidates."""

from sphereorient.search.candidates import Candidates, FallbackProposer, Proposals, Proposer
from sphereorient.search.grey_search import GreySearch
from sphereorient.search.normalisation import crop_disk
from sphereorient.search.settings import GreySearchSettings, OrientSettings, ProposeSettings
from sphereorient.search.template_bank import TemplateBank, extract_paint
