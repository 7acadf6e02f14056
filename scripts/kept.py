"""Work that is kept by what it depends on: the code that makes it, and its inputs.

A comment or a docstring changes nothing; a changed line of a module that a piece of work imports, itself or through
others, does.
"""

from __future__ import annotations

import ast
import hashlib
import json
import subprocess
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

import rooms

from sphereorient.files.whole_file import write_text

SCRIPTS = Path(__file__).resolve().parent
RECORD = "made_of.json"  # in a folder; beside a file: its name with this ending


def code_of(scripts: Iterable[Path], without: Iterable[str] = ()) -> set[Path]:
    """Return the files of code, C sources too, that scripts or modules depend on, but for those `without`."""
    known, found, todo = rooms.modules(), set[Path](), list(scripts)
    while todo:
        path = todo.pop()
        if path in found:
            continue
        found.add(path)
        for name in rooms.imports(path, known) | _beside(path):
            parts = name.split(".")
            if name not in known and not (SCRIPTS / f"{name}.py").is_file():
                continue
            if any(".".join(parts[: k + 1]) in set(without) for k in range(len(parts))):
                continue
            # What a module imports runs its packages' front doors as well.
            todo += [known[part] for k in range(1, len(parts) + 1) if (part := ".".join(parts[:k])) in known]
            todo += [SCRIPTS / f"{name}.py"] if name not in known else []
    return found | {source for path in found if (source := path.with_suffix(".c")).is_file()} | _compiled(found)


def _beside(path: Path) -> set[str]:
    """Return the scripts that a script imports."""
    if path.parent != SCRIPTS:
        return set()
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return names | {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}


def _compiled(found: set[Path]) -> set[Path]:
    """Return the C sources that modules named compiled.py call."""
    return {source for path in found if path.stem == "compiled" for source in path.parent.glob("*.c")}


@lru_cache(maxsize=1024)
def _meaning(path: Path, changed_ns: int) -> bytes:
    """Return what a file of code says, without comments and docstrings."""
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        match getattr(node, "body", None):
            case [ast.Expr(value=ast.Constant() as text), *_]:
                text.value = None
    return ast.dump(tree).encode()


def digest(files: Iterable[Path], *inputs: Any) -> str:
    """Return a word for what files of code say and for inputs that `repr` tells apart."""
    told = hashlib.sha256(repr(inputs).encode())
    for path in sorted(files):
        told.update(path.name.encode() + _meaning(path, path.stat().st_mtime_ns))
    return told.hexdigest()[:16]


def record_of(made: Path) -> Path:
    """Return where it is kept what a file or a folder was made of."""
    return made / RECORD if made.is_dir() else made.with_name(f"{made.name}.{RECORD}")


def known(made: Path) -> dict[str, Any]:
    """Return what was noted of a file or a folder when it was made; empty: nothing."""
    try:
        found = json.loads(record_of(made).read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def note(made: Path, **words: Any) -> None:
    """Note what a file or a folder was made of."""
    write_text(record_of(made), json.dumps({"command": "sphereorient scripts", **words}) + "\n")


def commit() -> str:
    """Return the short name of the commit that is checked out; empty without git."""
    try:
        run = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=SCRIPTS, capture_output=True, text=True)
    except OSError:
        return ""
    return run.stdout.strip()
