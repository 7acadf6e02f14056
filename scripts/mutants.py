"""Change one formula of the core at a time, and check that a test fails.

    scripts/mutants.py [--only TEXT] [--jobs 2] [--list]

Each mutant of scripts/mutants.yaml is applied in a temporary copy of the package. The quick tests of its room run
first, the most likely file before the others, then its slow ones, then tests/end_to_end; the first failure ends it.
Results are kept in out/mutants.json, and a second call continues there unless package or tests changed. Exits 1 if a
mutant survives, or if its text is not found.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import yaml

REPO = Path(__file__).resolve().parents[1]
RESULTS = REPO / "out" / "mutants.json"
LONGEST_S = 1200  # of one call of pytest; a mutant that takes longer hangs, and counts as killed
# Exit codes of pytest; a module that cannot be imported interrupts it.
FAILED, INTERRUPTED, PASSED, NO_TESTS = 1, 2, 0, 5


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One changed formula; read from mutants.yaml."""

    name: str
    room: str  # folder or file in sphereorient/, folder in tests/
    first: str  # pattern of the test files that run first
    old: str  # text in the room; every place is changed
    new: str  # equal to `old`: the unchanged package, whose tests must pass

    def files(self) -> list[Path]:
        """Return the files of the room that hold the old text."""
        room = REPO / "sphereorient" / self.room
        every = sorted(room.rglob("*.py")) or [room.with_suffix(".py")]
        return [path.relative_to(REPO) for path in every if self.old in path.read_text()]

    def calls(self) -> list[tuple[str, list[Path]]]:
        """Return mark and test files of each call of pytest, in order; the unchanged package runs quick ones only."""
        every = sorted((REPO / "tests" / self.room).rglob("test_*.py"))
        likely = [path for path in every if path.match(self.first)]
        rest = [path for path in every if path not in likely]
        end_to_end = sorted((REPO / "tests" / "end_to_end").glob("test_*.py"))
        calls = [("not slow", likely), ("not slow", rest), ("slow", every), ("not slow", end_to_end)]
        return [(mark, files) for mark, files in (calls[:2] if self.old == self.new else calls) if files]

    def run(self) -> str:
        """Return killed, survived or broken, with what killed it or why it is broken."""
        if not self.files():
            return f"broken: its text is not found in sphereorient/{self.room}"
        with tempfile.TemporaryDirectory() as folder:
            shutil.copytree(REPO / "sphereorient", Path(folder) / "sphereorient")
            for file in self.files():
                mutated = Path(folder) / file
                mutated.write_text(mutated.read_text().replace(self.old, self.new))
            for mark, tests in self.calls():
                code, last = _pytest(mark, tests, folder)
                if code in (FAILED, INTERRUPTED):
                    return f"killed: {last}"
                if code not in (PASSED, NO_TESTS):
                    return f"broken: pytest ended with {code}, {last}"
        return "survived"


def _pytest(mark: str, tests: Sequence[Path], package: str) -> tuple[int, str]:
    """Run test files against another copy of the package until one fails; return the exit code and the last word."""
    # PYTHONSAFEPATH: the working directory, with the package as it is, must not come first.
    environment = {**os.environ, "PYTHONPATH": package, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1"}
    # Hypothesis' profile "ci" has no deadlines: a busy machine kills no mutant.
    options = ["-q", "-x", "-p", "no:cacheprovider", "--hypothesis-profile", "ci", "-m", mark, "--tb=no"]
    command = [sys.executable, "-m", "pytest", *options]
    try:
        run = subprocess.run(
            [*command, *map(str, tests)], cwd=REPO, env=environment, capture_output=True, text=True, timeout=LONGEST_S
        )
    except subprocess.TimeoutExpired:
        return FAILED, f"no end after {LONGEST_S} s"
    lines = [line for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return run.returncode, (lines or run.stderr.splitlines() or [""])[0].split(" - ")[0]


def read() -> list[Mutant]:
    """Return the unchanged package once for each room, then all mutants."""
    mutants = [Mutant(**entry) for entry in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())]
    rooms = {mutant.room: mutant for mutant in mutants}
    unchanged = [
        Mutant(name=f"unchanged {room}", room=room, first="*", old=one.old, new=one.old) for room, one in rooms.items()
    ]
    return [*unchanged, *mutants]


def fingerprint() -> str:
    """Return a digest of the package and its tests: results of other ones do not count."""
    digest = hashlib.sha256()
    for path in sorted([*(REPO / "sphereorient").rglob("*.py"), *(REPO / "tests").rglob("*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="run the mutants whose room or name contains this text")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time")
    parser.add_argument("--list", action="store_true", help="show the mutants and whether their text is found")
    arguments = parser.parse_args()
    chosen = [one for one in read() if arguments.only in f"{one.room} {one.name}"]
    if arguments.list:
        for one in chosen:
            print(f"{one.room:10} {one.name:50} {', '.join(map(str, one.files())) or 'BROKEN: its text is not found'}")
        return int(not all(one.files() for one in chosen))
    known = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    print_of_all = fingerprint()
    if known.get("fingerprint") != print_of_all:
        known = {"fingerprint": print_of_all, "results": {}}
    results: dict[str, str] = known["results"]
    RESULTS.parent.mkdir(exist_ok=True)

    def run(one: Mutant) -> None:
        key = json.dumps([one.room, one.name, one.old, one.new])
        begin = time.perf_counter()
        if key not in results:
            results[key] = one.run()
            RESULTS.write_text(json.dumps(known, indent=1))
        outcome[one] = results[key]
        print(f"{one.room:10} {one.name:50} {outcome[one]} ({time.perf_counter() - begin:.0f} s)", flush=True)

    outcome: dict[Mutant, str] = {}
    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(run, chosen))
    wrong = [one for one in chosen if not outcome[one].startswith("survived" if one.old == one.new else "killed")]
    changed = [one for one in chosen if one.old != one.new]
    print(f"{sum(outcome[one].startswith('killed') for one in changed)} of {len(changed)} mutants killed")
    for one in wrong:
        print(f"{one.room}: {one.name}: {outcome[one]}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
