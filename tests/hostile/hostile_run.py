"""Judge all families with little memory and print the results: `python tests/hostile/hostile_run.py EXAMPLES`."""

from __future__ import annotations

import faulthandler
import json
import sys
import tempfile
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # as pytest does for tests
sys.path.insert(0, str(Path(__file__).parents[1]))

from hostile_files import file_families
from hostile_judge import Tally, little_memory
from hostile_texts import text_families


def main(examples: int, names: list[str]) -> None:
    """Print one line of JSON a family; the last line of stderr names the family, should the process die in it."""
    faulthandler.enable()
    warnings.simplefilter("ignore")
    families = text_families() | file_families()
    with tempfile.TemporaryDirectory() as folder:
        for k, name in enumerate(names or families):
            print(f"judging {name}", file=sys.stderr, flush=True)
            with little_memory():
                tally = families[name].run(Path(folder) / str(k), Tally(), examples)
            known = {"family": name, "distinct": len(tally.seen), "refused": tally.refused, "accepted": tally.accepted}
            rest = {"faults": tally.faults, "slowest_s": round(tally.slowest_s, 2), "slowest": tally.slowest}
            print(json.dumps(known | rest), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
