"""A few hostile inputs of every family; `test_hostile_thousand.py` has the rest."""

from __future__ import annotations

import pytest
from hostile_files import file_families
from hostile_judge import Tally, little_memory
from hostile_kinds import no_files
from hostile_texts import text_families

FAMILIES = text_families() | file_families()
EXAMPLES = 12


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.filterwarnings("ignore")
def test_hostile_inputs_are_answered_in_one_line(tmp_path, name):
    family, tally = FAMILIES[name], Tally()
    with little_memory():
        family.run(tmp_path, tally, EXAMPLES, written_out=False)
        for case in no_files():
            tally.judge(case, family.load, tmp_path / family.file)
    assert not tally.faults, "\n".join(tally.faults)
    assert tally.refused + tally.accepted == len(tally.seen) > EXAMPLES // 2
