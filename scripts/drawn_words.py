"""Print docstrings and messages drawn at random from the package, to judge its English.

python scripts/drawn_words.py --seed 71 --count 60

An item is a docstring, the arguments of a `refusal(` call, or the `help=` of an option. The draw is a hash of seed,
file and name: the same in every run, whatever the line numbers.
"""

import argparse
import ast
import hashlib
import textwrap
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "sphereorient"
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def items(node: ast.AST, name: str, variables: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each docstring, refusal and help text in a syntax tree."""
    if isinstance(node, DOCUMENTED):
        name = f"{name}.{getattr(node, 'name', '')}".strip(".")
        variables = variables | dict(pair for part in ast.walk(node) for pair in assigned(part))
        if text := ast.get_docstring(node):
            yield name, text
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "refusal":
        parts = [ast.unparse(part) for part in [*node.args, *(word.value for word in node.keywords)]]
        yield f"{name}, refusal", " | ".join(variables.get(part, part) for part in parts)
    if isinstance(node, ast.keyword) and node.arg == "help":
        yield f"{name}, help", ast.unparse(node.value)
    for part in ast.iter_child_nodes(node):
        yield from items(part, name, variables)


def assigned(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield the name and the source of each variable that a syntax tree assigns: parts of messages."""
    if isinstance(node, ast.Assign):
        target, value = node.targets[0], node.value
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            yield from ((ast.unparse(a), ast.unparse(b)) for a, b in zip(target.elts, value.elts, strict=False))
        else:
            yield ast.unparse(target), ast.unparse(value)


def main() -> None:
    """Print the drawn items."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=71, help="another seed draws other items")
    parser.add_argument("--count", type=int, default=60, help="number of items")
    options = parser.parse_args()
    drawn = []
    for file in sorted(PACKAGE.rglob("*.py")):
        place, counts = file.relative_to(PACKAGE.parent).as_posix(), dict[str, int]()
        for name, text in items(ast.parse(file.read_text(encoding="utf-8")), "", {}):
            counts[name] = number = counts.get(name, 0) + 1
            key = f"{options.seed} {place} {name} {number}"
            drawn.append((hashlib.sha256(key.encode()).hexdigest(), place, name or "module", text))
    for number, (_, place, name, text) in enumerate(sorted(drawn)[: options.count], start=1):
        print(f"{number}. {place}: {name}\n{textwrap.indent(text, '    ')}\n")
    print(f"{min(options.count, len(drawn))} of {len(drawn)}")


if __name__ == "__main__":
    main()
