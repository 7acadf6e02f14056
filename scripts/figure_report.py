"""Make docs/report.png and docs/overlay.png: the three commands of the walkthrough on the shared experiment.

    scripts/figure_report.py [EXPERIMENT] [--out out/walkthrough]

Runs track, report and overlay as a user does, photographs the page with Chromium (through Playwright) and takes one
frame of the overlay. Default: ../shared/experiment/experiment.yaml.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import av
from PIL import Image
from playwright.sync_api import sync_playwright

REPO = Path(__file__).resolve().parents[1]
EXPERIMENT = REPO.parent / "shared" / "experiment" / "experiment.yaml"
WIDTH, SCALE = 1280, 0.6  # px of the page, and of the picture
SHOWN = ("#summary", "#figure-track", "#frames")
FRAME = 120  # of the overlay


def main() -> None:
    """Read the options, run, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", type=Path, nargs="?", default=EXPERIMENT)
    parser.add_argument("--out", type=Path, default=REPO / "out" / "walkthrough")
    options = parser.parse_args()
    out, experiment = options.out, options.experiment
    out.mkdir(parents=True, exist_ok=True)
    sphereorient("track", experiment, "--out", out / "track.h5")
    sphereorient("report", out / "track.h5", "--experiment", experiment, "--out", out / "report")
    sphereorient("overlay", experiment, out / "track.h5", "--out", out / "overlay.mp4", "--force")
    photograph(out / "report" / "index.html", REPO / "docs" / "report.png")
    frame(out / "overlay.mp4", REPO / "docs" / "overlay.png")


def sphereorient(*arguments: object) -> None:
    """Run one command."""
    subprocess.run([sys.executable, "-m", "sphereorient.cli", *map(str, arguments)], check=True)


def photograph(page_path: Path, path: Path) -> None:
    """Put pictures of the page's parts below each other."""
    browser_path = shutil.which("chromium") or shutil.which("google-chrome")
    parts = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": 900})
        page.goto(page_path.resolve().as_uri())
        page.wait_for_timeout(500)
        for part in SHOWN:
            place = path.with_name(f".{path.stem}.{len(parts)}.png")
            page.locator(part).screenshot(path=place)
            parts.append(Image.open(place).convert("RGB"))
            parts[-1].load()
            place.unlink()
        browser.close()
    width, gap = max(part.width for part in parts), 16
    whole = Image.new("RGB", (width, sum(part.height + gap for part in parts)), "white")
    top = 0
    for part in parts:
        whole.paste(part, (0, top))
        top += part.height + gap
    smaller = whole.resize((round(SCALE * whole.width), round(SCALE * whole.height)), Image.Resampling.LANCZOS)
    smaller.save(path, optimize=True)


def frame(movie: Path, path: Path) -> None:
    """Take one frame of a movie."""
    with av.open(str(movie)) as container:
        for number, picture in enumerate(container.decode(video=0)):
            if number == FRAME:
                shown = picture.to_image()
                size = round(SCALE * shown.width), round(SCALE * shown.height)
                shown.resize(size, Image.Resampling.LANCZOS).save(path, optimize=True)
                return


if __name__ == "__main__":
    main()
