"""The strip of every frame's quality as a part of a page: HTML, style and script that need no network."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from jinja2 import Environment, StrictUndefined, Template

from sphereorient.report.gallery import Gallery, GalleryFrame
from sphereorient.report.strip import STATUS_WORDS, Stretch, stretches, strip_of
from sphereorient.trajectory import Trajectory

MOST_STRETCHES = 200  # rows of the table
UNFOLDED = 12  # pictures that are seen without JavaScript before anything is unfolded


def strip_html(name: str, track: Trajectory, gallery: Gallery | None) -> str:
    """Return the section of a page that shows the quality of every frame of a track.

    Without JavaScript it is a table of the stretches that are not good, and the pictures; with it, strips that can be
    clicked. Style and script are those of `strip_assets`, once a page, however many sections it has.

    Args:
        name: what the track is called on the page.
        track: what was measured.
        gallery: pictures of some of its frames; None: none are shown.

    Returns:
        HTML, everything in it escaped.
    """
    numbers = None if gallery is None else gallery.numbers
    strip, found = strip_of(track, numbers), stretches(track, numbers)
    ranked = [] if gallery is None else sorted(gallery.frames, key=lambda frame: frame.rank)
    return _template().render(
        name=name,
        data=strip.as_json(),
        strip=strip,
        stretches=found[:MOST_STRETCHES],
        more=found[MOST_STRETCHES:],
        reasons=_reasons,
        gallery=gallery,
        unfolded=ranked[:UNFOLDED],
        folded=sorted(ranked[UNFOLDED:], key=lambda frame: frame.k),
        caption=_caption,
    )


def strip_assets() -> tuple[str, str]:
    """Return style and script of the strips, for the head of a page."""
    return _asset("strip.css"), _asset("strip.js")


@cache
def _template() -> Template:
    """Compile the section's template; numbers that JSON does not know are refused."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(_asset("strip.html.j2"))


def _asset(name: str) -> str:
    return files("sphereorient.report").joinpath(name).read_text(encoding="utf-8")


def _reasons(stretch: Stretch) -> str:
    """Return why a stretch is not good, in words, and of how many frames each is said."""
    told = [f"{words} ({count})" for words, count in stretch.reasons]
    return "; ".join(told) or "no reason given"


def _caption(frame: GalleryFrame) -> str:
    """Return what stands under a picture: what the frame is, and why it was chosen."""
    status = STATUS_WORDS[frame.status]
    words = [words for words in frame.words if words != status]
    return "; ".join([status, *words]) if not words or not words[0].startswith(status) else "; ".join(words)
