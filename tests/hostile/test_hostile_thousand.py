"""More than a thousand malformed inputs, each answered by one line: no other error, no hang, no huge allocation."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = 150  # generated of each family, beside its written-out cases
MINUTES = 12


@pytest.mark.slow
def test_more_than_a_thousand_malformed_inputs_are_answered_in_one_line_each():
    # In a process of its own: a parser in C that crashes or hangs would take the tests along.
    script = Path(__file__).with_name("hostile_run.py")
    run = subprocess.run(
        [sys.executable, str(script), str(EXAMPLES)], capture_output=True, text=True, timeout=60 * MINUTES
    )
    tallies = [json.loads(line) for line in run.stdout.splitlines()]
    for tally in tallies:
        print("{family:18s} {distinct:5d} inputs, {refused:5d} refused, {accepted:4d} accepted".format(**tally))
    whole = {key: sum(tally[key] for tally in tallies) for key in ("distinct", "refused", "accepted")}
    print("together {distinct} inputs: {refused} refused in one line, {accepted} accepted".format(**whole))
    assert run.returncode == 0, f"the process died: {run.stderr[-2000:]}"
    faults = [f"{tally['family']}: {fault}" for tally in tallies for fault in tally["faults"]]
    assert not faults, "\n".join(faults)
    assert whole["refused"] >= 1000
    assert whole["refused"] + whole["accepted"] == whole["distinct"]
