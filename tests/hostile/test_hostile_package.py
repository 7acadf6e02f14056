"""Nothing in the package turns bytes of a file into running code."""

from __future__ import annotations

import ast

import pytest
from conftest import REPO

FILES = sorted((REPO / "sphereorient").rglob("*.py"))
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
BUILTINS = {"eval", "exec", "compile", "__import__"}
# Loaders of PyYAML that build more than plain values; load and load_all take any of them.
YAML = {"load", "load_all", "unsafe_load", "full_load", "unsafe_load_all", "full_load_all"}
YAML |= {"Loader", "UnsafeLoader", "FullLoader", "CLoader", "CUnsafeLoader", "CFullLoader"}


def dangers(tree: ast.AST) -> list[str]:
    """Places of a file that could run code from another file."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            module = getattr(node, "module", None) or ""
            found += [f"imports {name}" for name in [*names, module] if name.split(".")[0] in MODULES]
            found += [f"imports {name} of yaml" for name in names if module == "yaml" and name in YAML]
        elif isinstance(node, ast.Call):
            found += _dangers_of_call(node)
    return found


def _dangers_of_call(call: ast.Call) -> list[str]:
    name = ast.unparse(call.func)
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    owner, _, method = name.rpartition(".")
    if name in BUILTINS:
        return [name]
    if owner == "yaml" and method in YAML:
        return [name]
    if name in ("torch.load", "torch.hub.load_state_dict_from_url") and keywords.get("weights_only") != "True":
        return [f"{name} without weights_only=True"]
    if method == "load_from_checkpoint" and keywords.get("weights_only") != "True":
        return [f"{name} without weights_only=True"]
    if keywords.get("allow_pickle", "False") != "False":
        return [f"{name} with allow_pickle"]
    if name in ("np.load", "numpy.load") and "allow_pickle" not in keywords and len(call.args) < 3:
        return [f"{name} without allow_pickle=False"]
    if keywords.get("shell", "False") != "False" or name in ("os.system", "os.popen"):
        return [f"{name} through a shell"]
    return []


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(REPO)))
def test_no_file_of_the_package_runs_code_from_a_file(path):
    assert not dangers(ast.parse(path.read_text()))


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "import os, dill.source",
        "eval(text)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
        "yaml.unsafe_load(text)",
        "from yaml import UnsafeLoader",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "Model.load_from_checkpoint(path)",
        "np.load(path, allow_pickle=True)",
        "np.load(path)",
        "os.system(text)",
        "subprocess.run(text, shell=True)",
    ],
)
def test_dangerous_code_is_found(code):
    assert dangers(ast.parse(code))


def test_safe_code_is_not_found():
    safe = "yaml.safe_load(t); torch.load(p, weights_only=True); np.load(p, allow_pickle=False); model.eval()"
    assert not dangers(ast.parse(safe))
