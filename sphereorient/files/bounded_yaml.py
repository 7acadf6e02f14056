"""YAML from anybody: plain values only, with a bound on everything that could grow."""

from __future__ import annotations

import unicodedata
from typing import Any

import yaml
from yaml.composer import ComposerError

MAX_DEPTH = 30  # ours have five levels
MAX_NODES = 20_000  # with every alias counted as often as it is used; a covariance of 100 parameters has 10,000
MAX_TEXT = 4096  # characters of one value, as of a path
MAX_NUMBER = 64  # of a number: what has more digits is no measurement, takes long to convert, and fills messages
MAX_KEY = 100  # characters of a key: it appears in messages

NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
# Controls, halves of characters, and ends of lines that are no line feed: in no name, and in no message of one line.
UNSEEN = frozenset({"Cc", "Cs", "Zl", "Zp"})

FAULTS = (yaml.YAMLError, ValueError, OverflowError)  # a date that does not exist is a ValueError, 1:1:...:1.5 the last


def parse_yaml(text: str) -> Any:
    """Parse YAML of mappings, lists, texts, numbers and dates.

    Args:
        text: one document. Anchors, aliases and merge keys may be used, tags may not.

    Returns:
        What it says.

    Raises:
        yaml.YAMLError: no YAML, or with tags, keys given twice, keys that are no names, or something beyond the bounds.
        ValueError: a value that is none, such as a date that does not exist.
        OverflowError: a number to the base 60 that is too large.
    """
    return _BoundedLoader(text).get_single_data()


def is_one_line(text: str) -> bool:
    """Tell whether a text can stand in a message of one line."""
    return text.isprintable() or not any(unicodedata.category(letter) in UNSEEN for letter in text)


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which builds nothing but plain values, with bounds checked while nodes are composed.

    What is checked before any value is built cannot grow: aliases cost nothing here, but what walks through the values
    later (merging, validation, a message) meets each as often as it is used.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._nodes = 0
        self._size: dict[yaml.Node, int] = {}  # nodes of each finished node, itself included

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node and count it."""
        event, before = self._next(), self._nodes
        self._depth, self._nodes = self._depth + 1, self._nodes + 1
        self._check(self._depth <= MAX_DEPTH, f"more than {MAX_DEPTH} levels", event)
        self._check(getattr(event, "tag", None) in (None, "!"), "a tag, which is not used here", event)
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            self._check(node in self._size, "a value that contains itself", event)
            self._nodes += self._size.get(node, 0) if node is not None else 0
        elif node is not None:
            self._size[node] = self._nodes - before
        self._check(self._nodes <= MAX_NODES, f"more than {MAX_NODES} values", event)
        self._depth -= 1
        return node

    def compose_scalar_node(self, anchor: Any) -> yaml.ScalarNode:
        """Compose a text, a number or the like."""
        event = self._next()
        node = super().compose_scalar_node(anchor)
        longest = MAX_NUMBER if node.tag in NUMBERS else MAX_TEXT
        self._check(len(node.value) <= longest, f"a value of more than {longest} characters", event)
        self._check(is_one_line(node.value), "a text of several lines, or with control characters", event)
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping whose keys are different names."""
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            plain = isinstance(key, yaml.ScalarNode) and len(key.value) <= MAX_KEY
            self._check(plain, f"a key that is no name of at most {MAX_KEY} characters", key)
            self._check(key.value not in seen, f"the key '{key.value}' twice", key)
            seen.add(key.value)
        return node

    def _next(self) -> yaml.Event:
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        return event

    def _check(self, holds: bool, problem: str, at: Any) -> None:
        if not holds:
            raise ComposerError(None, None, problem, at.start_mark)
