"""Without posix modules and `fork`: what Windows lacks (`make test-portable` runs all quick tests so)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPO

HIDDEN = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), str(REPO)])}
EVERY = """
import sys, pkgutil, importlib, os
import sphereorient
for found in pkgutil.walk_packages(sphereorient.__path__, "sphereorient."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)
assert sys.modules["fcntl"] is sys.modules["resource"] is None and not hasattr(os, "fork")
"""


@pytest.mark.slow
def test_every_module_is_imported_without_posix():
    """Before: `import fcntl` in run/store.py ended `track` on Windows."""
    result = subprocess.run([sys.executable, "-c", EVERY], env=HIDDEN, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_files_runs_and_workers_work_without_posix(tmp_path):
    """Locks, parts, --resume, workers, outputs: the quick tests of these rooms, and two workers on one movie."""
    rooms = [*("tests/files", "tests/run", "tests/cli/test_outputs.py"), "--deselect=tests/run/test_full_disk.py"]
    for words in (["-m", "not slow", *rooms], ["tests/run/test_drive.py", "-k", "two_workers"]):
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--basetemp={tmp_path}/t", *words]
        result = subprocess.run(command, env=HIDDEN, cwd=REPO, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stdout[-3000:]
        assert " passed" in result.stdout
