"""Spoilt inputs: paths without a file, bytes, texts, and YAML documents."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import yaml
from hostile_judge import PLACES, Case
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

BOM = "﻿"


def no_files(content: bytes = b"") -> list[Case]:
    """Everything that may stand where a file is expected."""
    filled = ("sparse", "padded")
    return [Case(place, content if place in filled else b"", place) for place in PLACES]


def no_text(valid: bytes) -> list[Case]:
    """A valid text in encodings that are not ours, and bytes that are no text at all."""
    text = valid.decode()
    return [
        Case("empty"),
        Case("one line feed", b"\n"),
        Case("one zero byte", b"\0"),
        Case("zeros", bytes(5000)),
        Case("all bytes", bytes(range(256)) * 20),
        Case("utf-16", text.encode("utf-16")),
        Case("utf-16 without mark", text.encode("utf-16-le")),
        Case("utf-32", text.encode("utf-32")),
        Case("latin-1", ("# gr\xf6\xdfe\n" + text).encode("latin-1")),
        Case("with a mark", (BOM + text).encode()),
        Case("with two marks", (BOM * 2 + text).encode()),
        Case("zero byte at the end", valid + b"\0"),
        Case("escape sequences", valid + b"\x1b[2J\x07\x08"),
        Case("line feeds of all kinds", valid.replace(b"\n", b"\r") + b"\x0b\x0c\x1c\x85"),
        Case("one long line", b"a" * 3_000_000),
        Case("a long line behind", valid + b"x" * 300_000),
        Case("many lines", b"a\n" * 400_000),
        Case("only blanks", b" " * 200_000),
        Case("only tabs", b"\t" * 2000),
        Case("a picture", b"\x89PNG\r\n\x1a\n" + bytes(100)),
        Case("a program", b"\x7fELF" + bytes(range(256))),
    ]


@st.composite
def spoilt_bytes(draw: DrawFn, valid: Sequence[bytes]) -> Case:
    """A valid file cut off, with bits flipped, bytes replaced, a piece taken out, doubled, or moved."""
    content = bytearray(draw(st.sampled_from(list(valid))))
    how = draw(st.sampled_from(["cut", "flip", "flip", "fill", "without", "doubled", "insert", "head"]))
    at = draw(st.integers(0, max(len(content) - 1, 0)))
    if how == "cut":
        del content[at:]
    elif how == "flip":
        for _ in range(draw(st.sampled_from([1, 1, 2, 8, 64]))):
            content[draw(st.integers(0, len(content) - 1))] ^= 1 << draw(st.integers(0, 7))
    elif how == "fill":
        run = draw(st.sampled_from([1, 2, 4, 8, 100]))
        content[at : at + run] = bytes([draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]))]) * run
    elif how == "without":
        del content[at : at + draw(st.integers(1, 200))]
    elif how == "doubled":
        content[at:at] = content[at : at + draw(st.integers(1, 500))] * draw(st.sampled_from([1, 2, 50]))
    elif how == "insert":
        content[at:at] = draw(st.binary(min_size=1, max_size=40))
    else:  # in headers, extreme numbers of four bytes
        at = draw(st.integers(0, min(len(content), 200) // 4)) * 4
        number = draw(st.sampled_from([0, 1, 2, 255, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 10**9]))
        content[at : at + 4] = number.to_bytes(4, draw(st.sampled_from(["little", "big"])))
    return Case(how, bytes(content))


def garbage() -> SearchStrategy[Case]:
    """Random bytes."""
    return st.binary(max_size=300).map(lambda content: Case("garbage", content))


# What may stand for a value in YAML, as it is written there.
PLAIN = r"""
null ; true ; ~ ; '' ; 0 ; -1 ; -0.0 ; 1.5 ; .nan ; .inf ; -.inf ; 1e400 ; 1.0e+400 ; 1.0e+308 ; -1.0e+308 ;
1.0e-320 ; 2001-99-99 ; 2001-01-01 ; 2001-12-14t21:59:43.10-05:00 ; [] ; {} ; [1] ; *nothing ;
!!python/name:os.system ; ../../../../etc/passwd ; /etc/passwd ; /dev/zero ; /proc/self/mem ; @at ; `tick ; %percent ;
'open ; [open ; {open ;
[[1, 2], [3]] ; [1, 2, 3, 4, 5] ; ['a', 'b', 'c'] ; [.nan, .nan, .nan] ; [.nan, .inf] ; [.inf, .inf] ;
[1.0e+308, 1.0e+308, 1.0e+308] ; [0, 0, 0] ; [0, 0] ; [-1, -1] ; [true, true] ; [1000000000, 1000000000] ;
[[.nan, 0, 0], [0, 1, 0], [0, 0, 1]] ; [[1, 0, 0], [0, 1, 0], [0, 0, -1]] ; [[1, 0, 0], [0, 1, 0], [0, 0, 1.1]] ;
[[0, 0, 0], [0, 0, 0], [0, 0, 0]] ; [[1.0e+308, 0, 0], [0, 1.0e+308, 0], [0, 0, 1.0e+308]] ; {a: 1} ;
{a: {b: {c: d}}} ; {1: 2} ; {null: null} ; {? [a, b] : c} ; {? {a: b} : c} ; {'': ''} ; {"a\nb": 1} ;
{"\e[31m": {}} ; &a [*a] ; &a {b: *a} ; &a {? *a : 1} ; [&a x, *a, *a] ; [&a {f: 1}, {<<: *a}] ; {<<: 1} ;
{<<: [1]} ; {<<: &b {<<: *b}} ; {a: 1, a: 2} ; !!python/object/apply:os.system ['true'] ;
!!python/object/new:type ['x'] ; !!python/tuple [1, 2] ; !!binary AAECAw== ; !!binary '?' ; !!set {a, b} ;
!!omap [a: 1, b: 2] ; !!pairs [a: 1] ; !!float abc ; !!int abc ; !!int '' ; !!bool 7 ; !!timestamp x ; !!null 3 ;
!!str 3 ; !mine {a: 1} ; !<tag:yaml.org,2002:opencv-matrix> {rows: 1} ; "a\0b" ; "a\nb" ; "a\u2028b" ; "\ud800" ;
"\U00110000" ; "open
"""
VALUES = [value.strip() for value in PLAIN.split(";")] + ['"\\e]0;title\\a"', "''\n---\nb: 1", "| \n  text", "\t"]
VALUES += ["0x" + "f" * 5000, "0b" + "1" * 5000, ":".join(["1"] * 500), ":".join(["1"] * 500) + ".5"]
VALUES += [
    "[" + "9" * 400 + ", 3]",
    "{" + "k" * 3000 + ": 1}",
    "{" + ", ".join(f"k{i}: {i}" for i in range(2000)) + "}",
]
VALUES += ["{a: " * 3000 + "1" + "}" * 3000, "[" * 100_000, "- " * 2000 + "1"]
VALUES += ["9" * n for n in (30, 400, 3000, 6000)] + ["[" * n + "]" * n for n in (30, 5000)]
VALUES += ["x" * n for n in (300, 5000)]

BOMBS = {
    "billion laughs": "a: &a [lol, lol, lol, lol, lol, lol, lol, lol, lol]\n"
    + "".join(f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "billion keys": "a: &a {k: 1}\n"
    + "".join(
        f"{b}: &{b} {{{', '.join(f'k{n}: *{a}' for n in range(9))}}}\n"
        for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    ),
    "merged without end": "a: &a {k: 1}\n"
    + "".join(f"{b}: &{b} {{<<: [{', '.join(['*' + a] * 9)}]}}\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "itself": "&a\nschema: *a\n",
    "itself as key": "&a\n? *a\n: 1\n",
    "deep lists": "[" * 20_000,
    "deep lists that end": "[" * 20_000 + "]" * 20_000,
    "deep mappings": "{a: " * 20_000,
    "deep blocks": "- " * 20_000 + "1\n",
    "deep keys": "? " * 20_000 + "1\n",
    "deep lines": "".join(" " * k + "a:\n" for k in range(1200)),
    "many keys": "".join(f"key{k}: {k}\n" for k in range(60_000)),
    "many items": "a: [" + "1, " * 250_000 + "1]\n",
    "many documents": "--- a\n" * 50_000,
    "many anchors": "".join(f"a{k}: &a{k} 1\n" for k in range(20_000)),
    "a list": "- schema\n",
    "a text": "schema\n",
    "a number": "3\n",
    "directive": "%YAML 9.9\n---\na: 1\n",
    "tag directive": "%TAG ! tag:yaml.org,2002:python/\n---\na: !object/apply:os.system ['true']\n",
    "tabs": "a:\n\tb: 1\n",
    "sexagesimal": "a: " + ":".join(["59"] * 100_000) + "\n",
    "quoted": 'a: "' + "\\u0041" * 100_000 + '"\n',
    "comment": "#" * 500_000 + "\n",
}


def bombs(valid: str) -> list[Case]:
    """Whole files that are larger than they look, in front of a valid one and alone."""
    cases = [Case(name, text.encode()) for name, text in BOMBS.items()]
    return cases + [Case(f"{name} behind", (valid + text).encode()) for name, text in BOMBS.items()]


def _places(tree: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [here] if here else []
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        found += _places(value, (*here, key))
    return found


PLACEHOLDER = "spoilt-here"


def with_value(document: dict[str, Any], place: tuple[Any, ...], value: str) -> str:
    """The document as YAML with a value, as it is written there, in one place."""
    tree = copy.deepcopy(document)
    inner = tree
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = PLACEHOLDER
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=False, width=10**6)
    return text.replace(PLACEHOLDER, value.replace("\n", "\n    "))


def all_values(document: dict[str, Any]) -> list[tuple[tuple[Any, ...], str]]:
    """Every place of a document with every value; far too many to run."""
    return [(place, value) for place in _places(document) for value in VALUES]


@st.composite
def spoilt_document(draw: DrawFn, documents: Sequence[dict[str, Any]]) -> Case:
    """A valid YAML document with one value or one key that is none."""
    document = draw(st.sampled_from(list(documents)))
    place = draw(st.sampled_from(_places(document)))
    how = draw(st.sampled_from(["value"] * 8 + ["without", "renamed", "added", "twice"]))
    if how == "value":
        value = draw(st.sampled_from(VALUES))
        return Case(f"{place} = {value[:30]}", with_value(document, place, value).encode())
    tree = copy.deepcopy(document)
    inner = tree
    for step in place[:-1]:
        inner = inner[step]
    name = draw(st.sampled_from(["x", "X y", "\u00fc", "a.b", "0", "k" * 90, "R", "model", "cam3"]))
    if isinstance(inner, list):
        inner.append(copy.deepcopy(inner[place[-1]]))
        how = "longer"
    elif how == "without":
        del inner[place[-1]]
    elif how == "renamed":
        inner[name] = inner.pop(place[-1])
    else:
        inner[name] = draw(st.sampled_from([None, 1, "x", [], {}, [[1.0]], {"a": 1}]))
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=False)
    if how == "twice":
        line = draw(st.sampled_from([line for line in text.splitlines() if ":" in line]))
        text = text.replace(line, f"{line}\n{line}", 1)
    return Case(f"{how} {place}", text.encode())
