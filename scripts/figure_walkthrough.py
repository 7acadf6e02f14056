"""Run the commands of docs/walkthrough.md as a user does, and write what they print into the blocks below them.

    scripts/figure_walkthrough.py

A printed line replaces the line of a block that has the same words; tests/test_docs.py compares them.
"""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
import tempfile
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "walkthrough.md"


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced blocks of a language in a page."""
    return [body for kind, body in re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S) if kind == language]


def printed(text: str, folder: Path) -> list[str]:
    """Return the lines that the page's commands and Python print in a folder."""
    (folder / ".venv").symlink_to(sys.prefix)
    (folder / "out").mkdir()
    output = ""
    with contextlib.chdir(folder):
        for command in [line for block in blocks(text, "") for line in block.splitlines()]:
            output += subprocess.run(command.split(), check=True, stdout=subprocess.PIPE, text=True).stdout
        names: dict[str, object] = {}
        with contextlib.redirect_stdout(io.StringIO()) as python:
            for block in blocks(text, "python"):
                exec(block, names)
    return (output + python.getvalue()).splitlines()


def words(line: str) -> str:
    """Return a line without its numbers and spacing; numbers in names, as cam1, stay."""
    return " ".join(re.sub(r"(?<![\w/])\d[\d.]*|[│┃|]", " ", line).split())


def main() -> None:
    """Run, and write the page."""
    text = PAGE.read_text("utf-8")
    with tempfile.TemporaryDirectory() as folder:
        now = {words(line): line.rstrip() for line in reversed(printed(text, Path(folder)))}  # the first one counts
    for block in blocks(text, "text"):
        lines = [now.get(words(line), line) for line in block.splitlines()]
        text = text.replace(block, "".join(f"{line}\n" for line in lines))
    PAGE.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
