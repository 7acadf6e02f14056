"""Print the number of words of each page of the docs and in all, and each sentence that stands twice; exit code 1 if
one does, or if there are more than `MOST` words.

A word has a letter or a digit; code and tables count (`wc -w`, in brackets, counts the bars of tables, too).
docs/history.md is left out of the sum. A sentence has six words or more; headings, code and tables have none.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
NOT_COUNTED = {"history.md"}  # the record of earlier states
WORDS_OF_A_SENTENCE = 6
MOST = 38_000  # words


def is_word(part: str) -> bool:
    """Return whether a part between blanks has a letter or a digit."""
    return any(map(str.isalnum, part))


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
    counts = {name: (sum(map(is_word, text.split())), len(text.split())) for name, text in docs.items()}
    for name, (words, parts) in sorted(counts.items(), key=lambda item: -item[1][0]):
        print(f"{words:7,} ({parts:,})  {name}{'  (not in the sum)' if name in NOT_COUNTED else ''}")
    words, parts = (sum(counts[name][i] for name in docs if name not in NOT_COUNTED) for i in (0, 1))
    print(f"{words:7,} ({parts:,})  in all")
    found = twice(docs | {name: (REPO / name).read_text("utf-8") for name in ("README.md", "CONTRIBUTING.md")})
    for sentence, names in found.items():
        print(f"{len(names)} times, {', '.join(dict.fromkeys(names))}: {sentence}")
    return int(bool(found) or words > MOST)


if __name__ == "__main__":
    sys.exit(main())
