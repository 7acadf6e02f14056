"""Print the words of each page of the docs and in all, and each sentence that stands twice (exit code 1).

Words are counted as `wc -w` does, with code and tables; docs/history.md is left out of the sum. A sentence has six
words or more; headings, code blocks and tables have none.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
NOT_COUNTED = {"history.md"}  # what was, for those who ask
WORDS_OF_A_SENTENCE = 6


def sentences(text: str) -> list[str]:
    """Return the sentences of a page of Markdown, in lower case, without marks and addresses of links."""
    text = re.sub(r"^```.*?^```", "\n", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"^(\||#|!\[).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^ *(?:[-*]|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    found = re.split(r"(?<=[.!?:])[*_)]*\s+|\n\s*\n", text)
    plain = [re.findall(r"[\w-]+", sentence.lower()) for sentence in found]
    return [" ".join(words) for words in plain if len(words) >= WORDS_OF_A_SENTENCE]


def twice(pages: dict[str, str]) -> dict[str, list[str]]:
    """Return each sentence that stands more than once, with the names of its pages."""
    places = defaultdict(list)
    for name, text in pages.items():
        for sentence in sentences(text):
            places[sentence].append(name)
    return {sentence: names for sentence, names in places.items() if len(names) > 1}


def main() -> int:
    """Print both lists."""
    docs = {path.name: path.read_text("utf-8") for path in sorted((REPO / "docs").glob("*.md"))}
    words = {name: len(text.split()) for name, text in docs.items()}
    for name, count in sorted(words.items(), key=lambda item: -item[1]):
        print(f"{count:7,}  {name}{'  (not counted)' if name in NOT_COUNTED else ''}")
    print(f"{sum(count for name, count in words.items() if name not in NOT_COUNTED):7,}  in all")
    found = twice(docs | {name: (REPO / name).read_text("utf-8") for name in ("README.md", "CONTRIBUTING.md")})
    for sentence, names in found.items():
        print(f"{len(names)} times, {', '.join(dict.fromkeys(names))}: {sentence}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
