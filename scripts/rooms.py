"""Print the rooms of the package, what each imports, and every import that points downwards; draw the picture.

.venv/bin/python scripts/rooms.py            # prints; exits 1 where an import points downwards or in a circle,
                                             # or a room has more lines than CONTRIBUTING.md allows
.venv/bin/python scripts/rooms.py --write    # also writes the list and the picture of CONTRIBUTING.md
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
PACKAGE = REPO / "sphereorient"
# A room imports only from those before it.
ORDER = (
    *("errors", "files", "so3", "cameras", "movies", "sphere", "trajectory", "calibration", "experiment", "locate"),
    *("pose", "search", "follow", "assemble", "motion", "synth", "statistics", "learn", "mapping", "methods", "run"),
    *("preflight", "report", "tools", "live", "bench", "cli"),
)

LONG, MANY = "functions over 60 lines", "functions of over 6 arguments"


def modules() -> dict[str, Path]:
    """Return the modules of the package by dotted name without the package's."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """Return the modules of the package that a file imports anywhere, without the package's name."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            raise SystemExit(
                f"{path}: expected imports from sphereorient in full, got a relative one; write it in full."
            )
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "sphereorient":
            for alias in node.names:
                whole = f"{node.module}.{alias.name}".removeprefix("sphereorient.")
                names.add(whole if whole in known else str(node.module).removeprefix("sphereorient").removeprefix("."))
        elif isinstance(node, ast.Import):
            names |= {a.name.removeprefix("sphereorient.") for a in node.names if a.name.startswith("sphereorient.")}
    return names - {""}


def room(module: str) -> str:
    """Return the room that a module is in."""
    return module.split(".")[0]


def arrows() -> dict[str, set[str]]:
    """Return the rooms that each room imports."""
    known = modules()
    found: dict[str, set[str]] = defaultdict(set)
    for name, path in known.items():
        if name:  # sphereorient/__init__.py exports names of all rooms, on demand
            found[room(name)] |= {room(other) for other in imports(path, known)} - {room(name)}
    return found


def downward() -> list[str]:
    """Return the imports that do not point to an earlier room."""
    known, found = modules(), []
    for name, path in known.items():
        if not name:
            continue
        for other in sorted(imports(path, known)):
            if room(name) not in ORDER or room(other) not in ORDER:
                found.append(f"{name} -> {other} (not a room)")
            elif ORDER.index(room(other)) > ORDER.index(room(name)):
                found.append(f"{name} -> {other}")
    return found


def circles() -> list[str]:
    """Return the modules that import each other in a circle."""
    known = modules()
    graph = {name: imports(path, known) & known.keys() - {name} for name, path in known.items() if name}
    left = {name: set(others) for name, others in graph.items()}
    while free := [name for name, others in left.items() if not others & left.keys()]:
        for name in free:
            del left[name]
    return sorted(left)


@cache
def lines(name: str) -> tuple[int, int]:
    """Return the lines of a room, and those of them that are code: no blank line, comment or docstring."""
    total = code = 0
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[0] != name:
            continue
        text = path.read_text()
        quiet = set()
        for node in ast.walk(ast.parse(text)):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                quiet |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        rows = text.splitlines()
        total += len(rows)
        code += sum(
            bool(row.strip()) and not row.strip().startswith("#") and k not in quiet for k, row in enumerate(rows, 1)
        )
    return total, code


def sentence(name: str) -> str:
    """Return the first sentence of a room's docstring."""
    path = PACKAGE / name / "__init__.py"
    path = path if path.is_file() else PACKAGE / f"{name}.py"
    return (ast.get_docstring(ast.parse(path.read_text())) or "").split("\n")[0].rstrip(".")


def ceilings() -> dict[str, int]:
    """Return the largest number of lines of each room, from CONTRIBUTING.md."""
    rows = re.findall(r"^\| `(\w+)` \|.*\| ([\d,]+) \|$", (REPO / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    return {name: int(number.replace(",", "")) for name, number in rows}


def too_large() -> list[str]:
    """Return the rooms that have more lines than they may."""
    most = ceilings()
    sizes = {name: lines(name)[0] for name in ORDER}
    return [f"{name}: {size} lines, at most {most[name]}" for name, size in sizes.items() if size > most[name]]


def counts() -> dict[str, int]:
    """Return how many arrows, long functions, functions of many arguments and number constants the package has."""
    found = {"arrows": sum(map(len, arrows().values())), LONG: 0, MANY: 0, "number constants": 0}
    for path in modules().values():
        tree = ast.parse(path.read_text())
        found["number constants"] += sum(_numbers(node) for node in tree.body)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                found[LONG] += (node.end_lineno or node.lineno) - node.lineno >= 60
                found[MANY] += len([one for one in every if one.arg not in ("self", "cls")]) > 6
    return found


def _numbers(node: ast.stmt) -> int:
    """Return how many names a statement of a module assigns to numbers, or to tuples and tables of numbers."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    leaves = [leaf for leaf in ast.walk(node.value) if isinstance(leaf, ast.Constant | ast.Name)] if targets else []
    if not leaves or any(isinstance(leaf, ast.Name) or type(leaf.value) not in (int, float) for leaf in leaves):
        return 0
    return sum(isinstance(name, ast.Name) for target in targets for name in ast.walk(target))


def write_list() -> None:
    """Write the list of rooms into CONTRIBUTING.md; ceilings stay."""
    path, most = REPO / "CONTRIBUTING.md", ceilings()
    rows = ["| room | what | lines | at most |", "|---|---|---|---|"]
    rows += [f"| `{name}` | {sentence(name)} | {lines(name)[0]:,} | {most[name]:,} |" for name in ORDER]
    head, _, rest = path.read_text().partition("<!-- rooms -->\n")
    tail = rest.partition("<!-- end of rooms -->\n")[2]
    text = "\n".join(rows)
    path.write_text(f"{head}<!-- rooms -->\n{text}\n<!-- end of rooms -->\n{tail}")


def draw(path: Path) -> None:
    """Draw the rooms on a line, upwards, with an arc for each import."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Arc

    figure = Figure((7.0, 8.6), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    found = arrows()
    for high, name in enumerate(ORDER):
        axes.text(0.0, high, name, ha="right", va="center", fontsize=9, family="monospace")
        axes.text(-0.24, high, f"{lines(name)[0]:,}", ha="right", va="center", fontsize=7, color="#777777")
        for other in found[name]:
            low = ORDER.index(other)
            colour = "#0072B2" if low < high else "#D55E00"
            axes.add_patch(
                Arc(
                    (0.02, (high + low) / 2),
                    0.075 * abs(high - low),
                    abs(high - low),
                    theta1=-90,
                    theta2=90,
                    color=colour,
                    lw=0.5,
                )
            )
    axes.set(xlim=(-0.36, 1.0), ylim=(-0.8, len(ORDER) - 0.2))
    axes.set_axis_off()
    axes.set_title(
        "Rooms, their lines, and their imports: blue arcs end at an earlier room (below)", fontsize=9, loc="left"
    )
    figure.savefig(path, metadata={"Software": None})


def main() -> int:
    """Print all; return 1 where the rooms are not a line."""
    found, whole = arrows(), [0, 0]
    print(f"{'room':12} {'lines':>6} {'code':>6}  imports")
    for name in ORDER:
        total, code = lines(name)
        whole = [whole[0] + total, whole[1] + code]
        print(f"{name:12} {total:6} {code:6}  {' '.join(sorted(found[name], key=ORDER.index))}")
    front = len((PACKAGE / "__init__.py").read_text().splitlines())
    print(f"{'all':12} {whole[0] + front:6} {whole[1]:6}")
    if "--write" in sys.argv[1:]:
        write_list()
        draw(REPO / "docs" / "rooms.png")
    print("; ".join(f"{what}: {number}" for what, number in counts().items()))
    wrong, round_, large = downward(), circles(), too_large()
    for arrow in wrong:
        print(f"downward: {arrow}")
    for one in large:
        print(f"too large: {one}")
    print(f"downward imports: {len(wrong)}; modules in circles: {len(round_)} {' '.join(round_)}")
    return int(bool(wrong or round_ or large))


if __name__ == "__main__":
    sys.exit(main())
