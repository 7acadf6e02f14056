"""Print the public names that mean two things, the terms that docs/glossary.md lacks, and the retired words in names;
exit code 1 where there is any.

A public name, without leading underscore, is that of a class, a function or a type alias of a module of sphereorient/;
aliases of one definition are one. A term is the last word of the name of a public class: the glossary names it in
front of a colon. Retired words are looked for in all names that the code defines: of functions, arguments, variables.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
RETIRED = {"tell", "tells", "told", "shots", "study", "studies"}


def words(name: str) -> list[str]:
    """Return the words of a name in lower case, in the singular."""
    return [
        word.lower().removesuffix("s")
        for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", re.sub(r"\dD\b", "", name))
    ]


def definitions(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield the public names of a module, each with its definition."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name[0] != "_":
            yield node.name, ast.dump(node)
        elif isinstance(node, ast.Assign):
            name, value = ast.unparse(node.targets[0]), ast.unparse(node.value)
            if re.fullmatch(r"[A-Z][a-z]\w*", name) and "TypeVar" not in value:
                yield name, value


def meanings(trees: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Return the public names with several definitions, and a module of each."""
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for module, tree in trees.items():
        for name, definition in definitions(tree):
            found[name].setdefault(definition, module)
    return {name: list(modules.values()) for name, modules in found.items() if len(modules) > 1}


def unexplained(trees: dict[str, ast.Module], glossary: str) -> dict[str, list[str]]:
    """Return the terms that a glossary lacks, and the classes named by them."""
    known = {word for terms in re.findall(r"^- (\*\*[^:]*):", glossary, re.MULTILINE) for word in words(terms)}
    found = defaultdict(list)
    for node in (node for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef)):
        if node.name[0] != "_" and (term := words(node.name)[-1]) not in known:
            found[term].append(node.name)
    return dict(found)


def defined(tree: ast.Module) -> Iterator[str]:
    """Yield all names that a module defines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def retired(trees: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Return the names that hold a retired word, and their modules."""
    found = defaultdict(list)
    for module, tree in trees.items():
        for name in sorted(set(defined(tree))):
            if RETIRED & set(name.lower().split("_")):
                found[name].append(module)
    return dict(found)


def wrong() -> dict[str, dict[str, list[str]]]:
    """Return the three lists by title."""
    code = REPO / "sphereorient"
    trees = {str(path.relative_to(code)): ast.parse(path.read_text("utf-8")) for path in sorted(code.rglob("*.py"))}
    return {
        "public names of two meanings": meanings(trees),
        "terms that the glossary lacks": unexplained(trees, (REPO / "docs" / "glossary.md").read_text("utf-8")),
        "names with a retired word": retired(trees),
    }


def main() -> int:
    """Print the lists."""
    found = wrong()
    for title, names in found.items():
        print(f"{title}: {len(names)}")
        for name, places in sorted(names.items()):
            print(f"  {name}: {', '.join(places)}")
    return int(any(found.values()))


if __name__ == "__main__":
    sys.exit(main())
