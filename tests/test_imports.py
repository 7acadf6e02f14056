"""The rooms are a line: each imports only from those before it (CONTRIBUTING.md, Rooms)."""

from __future__ import annotations

import ast
import subprocess
import sys

import pytest
from conftest import REPO

ROOMS = (
    "errors outputs hdf5_out so3 cameras movies sphere experiment timeline trajectory locate orient assemble "
    "differentiable motion synth statistics learn paint settings provenance proposers results reel recording learnt "
    "paper precise pipeline calibrate preflight jobs evaluate report cli"
)
ORDER = ROOMS.split(" ")
FILES = sorted((REPO / "sphereorient").rglob("*.py"))


def room_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "sphereorient"


def imported(tree: ast.AST) -> list[str]:
    """Modules of the package that a file imports anywhere, `from sphereorient import so3` as sphereorient.so3."""
    names = []
    for node in ast.walk(tree):
        assert not (isinstance(node, ast.ImportFrom) and node.level), "write imports from sphereorient in full"
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "sphereorient":
            bare = node.module == "sphereorient"
            names += [f"sphereorient.{alias.name}" if bare else node.module for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names if alias.name.split(".")[0] == "sphereorient"]
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(REPO)))
def test_a_room_imports_only_from_rooms_before_it(path):
    parts = path.relative_to(REPO / "sphereorient").with_suffix("").parts
    if parts == ("__init__",):  # the front door hands out names of all rooms, on demand
        return
    here = ORDER.index(parts[0])
    for module in imported(ast.parse(path.read_text())):
        room = room_of(module)
        if room in ("__version__", "sphereorient"):
            continue
        assert ORDER.index(room) <= here, f"{path} imports {module}"


@pytest.mark.parametrize("code", ["import sphereorient", "import sphereorient.cli", "import sphereorient.trajectory"])
def test_the_front_door_does_not_wait_for_torch(code):
    heavy = "{'torch', 'kornia', 'pytorch_lightning', 'scipy.optimize', 'matplotlib', 'pandas'}"
    check = f"{code}; import sys; late = {heavy} & set(sys.modules); assert not late, late"
    subprocess.run([sys.executable, "-c", check], check=True)


def test_help_comes_without_torch():
    code = "import sys; sys.argv = ['sphereorient', '--help']\nfrom sphereorient import cli\ntry:\n    cli.main()\n"
    code += "except SystemExit as stop:\n    assert not stop.code\nassert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "track" in run.stdout
