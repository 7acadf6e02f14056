"""Keep results with a digest of the code that makes them and of their inputs.

A changed line of a module that the work imports, directly or through others, changes the digest; a comment or a
docstring does not.
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
    """Return the files of code, C sources too, that scripts or modules depend on, except those of `without`."""
    known, found, left_out, todo = _modules(), set[Path](), set(without), list(scripts)
    while todo:
        path = todo.pop()
        if path in found:
            continue
        found.add(path)
        for name in _imports(path):
            parts = name.split(".")
            # An import runs the __init__.py of its packages as well.
            whole = [".".join(parts[: k + 1]) for k in range(len(parts))]
            if not left_out.intersection(whole):
                todo += [known[part] for part in whole if part in known]
                todo += [] if name in known else filter(Path.is_file, [SCRIPTS / f"{name}.py"])
    return found | {source for path in found if (source := path.with_suffix(".c")).is_file()} | _compiled(found)


@lru_cache(maxsize=1)
def _modules() -> dict[str, Path]:
    return rooms.modules()


@lru_cache(maxsize=1024)
def _imports(path: Path) -> set[str]:
    """Return the modules of the package that a file imports, and, of a script, the scripts."""
    names = rooms.imports(path, _modules())
    if path.parent != SCRIPTS:
        return names
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module))
            # sphereorient/__init__.py exports names of all rooms.
            doors = node.module == "sphereorient" and any(alias.name not in _modules() for alias in node.names)
            names |= {"cli.app", "run"} if doors else set()
    return names | ({"cli.app", "run"} if "subprocess" in names else set())  # programs may do anything


def _compiled(found: set[Path]) -> set[Path]:
    """Return the C sources that modules named compiled.py call."""
    return {source for path in found if path.stem == "compiled" for source in path.parent.glob("*.c")}


@lru_cache(maxsize=1024)
def _meaning(path: Path, changed_ns: int) -> bytes:
    """Return the content of a file of code without comments and docstrings."""
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        match getattr(node, "body", None):
            case [ast.Expr(value=ast.Constant() as text), *_]:
                text.value = None
    return ast.dump(tree).encode()


def digest(files: Iterable[Path], *inputs: Any) -> str:
    """Return a digest of files of code and of inputs, compared by `repr`."""
    hasher = hashlib.sha256(repr(inputs).encode())
    for path in sorted(files):
        hasher.update(path.name.encode() + _meaning(path, path.stat().st_mtime_ns))
    return hasher.hexdigest()[:16]


def record_of(made: Path) -> Path:
    """Return the path of the record of a file or a folder."""
    return made / RECORD if made.is_dir() else made.with_name(f"{made.name}.{RECORD}")


def known(made: Path) -> dict[str, Any]:
    """Return the record of a file or a folder; empty: none."""
    try:
        found = json.loads(record_of(made).read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def note(made: Path, **words: Any) -> None:
    """Write the record of a file or a folder."""
    # `write_text` replaces only files with a `command` of ours.
    write_text(record_of(made), json.dumps({"command": "sphereorient scripts", **words}) + "\n")


def commit() -> str:
    """Return the short name of the commit that is checked out; empty without git."""
    try:
        run = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=SCRIPTS, capture_output=True, text=True)
    except OSError:
        return ""
    return run.stdout.strip()
