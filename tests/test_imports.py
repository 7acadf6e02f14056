"""The rooms are a line: each imports only from those before it (scripts/rooms.py)."""

import ast
import importlib
import inspect
import subprocess
import sys

import pytest
from conftest import REPO

sys.path.insert(0, str(REPO / "scripts"))
import mutants
import rooms


def test_every_import_points_to_an_earlier_room():
    assert rooms.downward() == []


def test_no_modules_import_each_other_in_a_circle():
    assert rooms.circles() == []


def test_every_folder_is_a_room_with_tests():
    folders = {path.parent.name for path in (REPO / "sphereorient").glob("*/__init__.py")}
    assert folders | {"errors", "so3"} == set(rooms.ORDER)


def test_tests_and_scripts_import_public_names():
    private = [
        f"{path.name}: {name.name}"
        for folder in ("tests", "scripts")
        for path in sorted((REPO / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("sphereorient")
        for name in node.names
        if name.name.startswith("_")
    ]
    assert private == []


def test_least_squares_of_torch_name_their_driver():
    # the default driver on a CPU reads unset memory: results differ from run to run
    default = [
        f"{path.name}:{node.lineno}"
        for path in sorted((REPO / "sphereorient").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("torch.linalg.lstsq")
        if all(word.arg != "driver" for word in node.keywords)
    ]
    assert default == []


@pytest.mark.parametrize("code", ["import sphereorient", "import sphereorient.cli", "import sphereorient.trajectory"])
def test_the_package_is_imported_without_torch(code):
    heavy = "{'torch', 'kornia', 'pytorch_lightning', 'scipy.optimize', 'matplotlib', 'pandas', 'rich.table'}"
    check = f"{code}; import sys; late = {heavy} & set(sys.modules); assert not late, late"
    subprocess.run([sys.executable, "-c", check], check=True)


def test_tracking_imports_no_unused_packages():
    unused = "{'kornia', 'pytorch_lightning', 'matplotlib', 'pandas'}"
    code = f"import sphereorient.methods.precise, sys; late = {unused} & set(sys.modules); assert not late, late"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_help_imports_no_torch():
    code = "import sys; sys.argv = ['sphereorient', '--help']\nfrom sphereorient import cli\ntry:\n    cli.main()\n"
    code += "except SystemExit as stop:\n    assert not stop.code\nassert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "track" in run.stdout


@pytest.mark.parametrize("path", sorted((REPO / "scripts").glob("*.py")), ids=lambda path: path.stem)
def test_a_script_uses_names_that_exist(path):
    tree = ast.parse(path.read_text())
    modules = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("sphereorient"):
            module = importlib.import_module(node.module)
            for name in node.names:
                there = hasattr(module, name.name)
                found = getattr(module, name.name) if there else importlib.import_module(f"{node.module}.{name.name}")
                if inspect.ismodule(found):
                    modules[name.asname or name.name] = found
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            assert hasattr(modules[node.value.id], node.attr), f"{node.value.id}.{node.attr}"


def test_no_room_is_larger_than_its_ceiling():
    assert set(rooms.ceilings()) == set(rooms.ORDER)
    assert rooms.too_large() == []


def test_each_mutant_changes_a_text_of_the_code():
    assert [one.name for one in mutants.read() if not one.files()] == []
