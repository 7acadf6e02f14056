"""A report: a folder with one page, the figures, and the tables."""

import base64
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import Camera, without_perspective
from sphereorient.errors import ExperimentError, OutputError, error_words, refusal
from sphereorient.experiment import Experiment
from sphereorient.files.threads import Progress, counted, silent
from sphereorient.files.whole_file import ROOM, has_mark, unfinished
from sphereorient.pose.worn import UNUSED_PAINT, worn_of_text
from sphereorient.report.frame_warnings import bad_stretches
from sphereorient.report.gallery import gallery
from sphereorient.report.page import page_html, strip_html
from sphereorient.report.plots import report_figures
from sphereorient.report.plots.style import Plan, of_tracks, write_figure
from sphereorient.report.tables import behaviour_tables, tables_of, write_tables
from sphereorient.report.texture_map import worn_figure
from sphereorient.report.verdicts import Verdict, verdicts
from sphereorient.sphere import load_texture
from sphereorient.statistics import StatisticsSettings, Surroundings, summarise
from sphereorient.statistics.behaviour import Behaviour
from sphereorient.statistics.cameras import camera_distances
from sphereorient.trajectory import Trajectory

KINDS = {"figures": (".png", ".pdf"), "tables": (".csv", ".parquet")}  # folders of a report, suffixes of files
MOST_STRIPS = 8  # tracks shown frame by frame
PICTURES = 120  # frames of a report with pictures
FLOW_KEYS = {
    "viscosity": "viscosity_m2_s",
    "dissipation": "dissipation_w_kg",
    "u_rms": "u_rms_m_s",
    "integral_length": "integral_length_m",
    "integral_time": "integral_time_s",
}


def write_report(
    tracks: Mapping[str, Trajectory],
    out: Path,
    *,
    experiments: Sequence[Experiment] = (),
    settings: StatisticsSettings | None = None,
    progress: Progress = silent,
    command: str = "",
    behaviours: Mapping[str, Behaviour] | None = None,
) -> list[Verdict]:
    """Write the report of tracks, by file name, whole or not at all; return its findings. `behaviours`: of tracks with
    a reference. Raises TrackError (no valid frame, or a mixture of tracks by kernels and by smoothers),
    ExperimentError (see `match_experiments`, `surroundings_of`), OutputError (see `check_report_folder`).
    """
    known = match_experiments(tracks, experiments)
    around = surroundings_of([experiment for experiment in known.values() if experiment is not None])
    names = list(tracks)
    name = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
    summary = summarise(list(tracks.values()), settings, around, partial(progress, "numbers"), name)
    rough = [None if (e := known[key]) is None else uncorrected(tracks[key], e.cameras) for key in tracks]
    of = summary, tracks, camera_distances(list(tracks.values()), rough)
    words = verdicts(*of)
    with _folder(out) as aside:
        tables = [*tables_of(*of), *behaviour_tables(behaviours or {})]
        page = page_html(
            summary,
            tracks,
            command,
            verdicts=words,
            tables=tables,
            suffixes=write_tables(tables, aside / "tables"),
            figures=_draw_all([*report_figures(of), *_worn(tracks, known)], aside / "figures", progress),
            strips=list(_strips(tracks, known, progress)),
        )
        (aside / "index.html").write_text(page, "utf-8")
    return words


def match_experiments(
    tracks: Mapping[str, Trajectory], experiments: Sequence[Experiment]
) -> dict[str, Experiment | None]:
    """Return the experiment of each track, with its sphere only, or None; a single one belongs to a single track.
    Raises ExperimentError: an experiment without track or sphere, or two of one name.
    """
    if len(tracks) == 1 and len(experiments) == 1:
        return {name: experiments[0].of(track.sphere) for name, track in tracks.items()}
    known: dict[str, Experiment] = {}
    wanted = {track.experiment for track in tracks.values()}
    for experiment in experiments:
        name = experiment.name
        if name in known:
            do = "give them different names (key `name`), or report them one by one"
            got = f"{known[name].path} and {experiment.path}"
            raise ExperimentError(refusal(f"--experiment '{name}'", expected="different names", got=got, do=do))
        if name not in wanted:
            do = "pass the experiment.yaml that the track was measured from"
            expected = f"the name of one of {', '.join(sorted(wanted)[:5])}"
            raise ExperimentError(refusal(str(experiment.path), expected=expected, got=name, do=do))
        known[name] = experiment
    return {
        name: known[track.experiment].of(track.sphere) if track.experiment in known else None
        for name, track in tracks.items()
    }


def surroundings_of(experiments: Sequence[Experiment]) -> Surroundings:
    """Return the properties of sphere and flow, without a diameter if spheres of one recording differ. Raises
    ExperimentError: contradictions.
    """
    known: dict[str, float] = {}
    sizes = {(one.path, one.diameter_mm) for one in experiments}
    for experiment in experiments:
        found = {FLOW_KEYS[key]: value for key, value in experiment.flow.items() if key in FLOW_KEYS}
        if experiment.diameter_mm is not None and sum(path == experiment.path for path, _ in sizes) == 1:
            found["diameter_mm"] = experiment.diameter_mm
        for key, value in found.items():
            if known.setdefault(key, value) != value:
                do = "report spheres and flows of each kind separately"
                label, got = f"{experiment.path}, {key}", f"{value:g}"
                raise ExperimentError(refusal(label, expected=f"{known[key]:g} as before", got=got, do=do))
    return Surroundings(**known)


def uncorrected(track: Trajectory, cameras: Mapping[str, Camera]) -> dict[str, NDArray[np.float64]]:
    """Return a track's orientations by each of the given cameras, as `without_perspective`."""
    return {
        name: without_perspective(
            cameras[name], torch.from_numpy(seen.centre_px), torch.from_numpy(seen.orientation)
        ).numpy()
        for name, seen in track.cameras.items()
        if name in cameras
    }


def _worn(tracks: Mapping[str, Trajectory], experiments: Mapping[str, Experiment | None]) -> Iterator[Plan]:
    drawn = set()
    for name, track in tracks.items():
        text, experiment = track.provenance.get(UNUSED_PAINT), experiments[name]
        if text is not None and text not in drawn:
            drawn.add(text)
            path = None if experiment is None else experiment.texture_path
            draw = partial(worn_figure, worn_of_text(text), None if path is None else load_texture(path))
            title = f"Paint{of_tracks([name], tracks)} that was not used"
            yield f"unused_paint_{len(drawn)}", title, "It differs from the map.", draw


def _draw_all(plans: Sequence[Plan], folder: Path, progress: Progress) -> list[dict[str, Any]]:
    drawn = []
    for name, title, caption, draw in counted("figures", plans, len(plans), progress):
        figure = draw()
        write_figure(figure, folder / name)
        png = base64.b64encode((folder / f"{name}.png").read_bytes()).decode()
        width = round(120 * figure.get_figwidth())  # on the page; one scale for all figures, so texts have equal size
        drawn.append({"name": name, "title": title, "caption": caption, "png": png, "width": width})
    return drawn


def _strips(
    tracks: Mapping[str, Trajectory], experiments: Mapping[str, Experiment | None], progress: Progress
) -> Iterator[str]:
    """Yield the quality strips of the tracks, at most those with the most bad frames."""
    bad = {name: sum(one.frames for one in bad_stretches(track)) for name, track in tracks.items()}
    worst = sorted(tracks, key=lambda name: -bad[name])[:MOST_STRIPS]
    chosen = [name for name in tracks if name in worst]
    pictured = sum(experiments[name] is not None for name in chosen)
    for k, name in enumerate(chosen):
        seen = None
        if (experiment := experiments[name]) is not None:
            count = max(PICTURES // pictured, 12)
            seen = gallery(tracks[name], experiment, count, partial(progress, "pictures"))
        yield strip_html(name, tracks[name], seen)
        progress("strips", k + 1, len(chosen))


@contextmanager
def _folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes the report at the end, or is removed after an error."""
    out = out.resolve()  # follow links
    check_report_folder(out)
    aside, old = unfinished(out), unfinished(out)
    try:
        for part in KINDS:
            (aside / part).mkdir(parents=True)
        yield aside
        check_report_folder(out)  # again, as it may have changed
        if out.exists():
            out.replace(old)
        aside.replace(out)
    except OSError as error:
        if old.exists() and not out.exists():
            old.replace(out)
        expected, got = "a folder that can be written", error_words(error)
        raise OutputError(refusal(f"--out {out}", expected=expected, got=got, do=ROOM)) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def check_report_folder(out: Path) -> None:
    """Raise OutputError if a folder contains more than an older report (its page carries the mark)."""
    page, found = out / "index.html", set(out.rglob("*"))
    named = page.read_text("utf-8", "replace") if has_mark(page) else ""  # of all that the older report made
    made = (path for part, kinds in KINDS.items() for kind in kinds for path in (out / part).glob(f"*{kind}"))
    ours = {path for path in made if f"{path.parent.name}/{path.stem}." in named}
    whole = has_mark(page) and found <= ours | {page, *(out / part for part in KINDS)}
    if (out.exists() and not out.is_dir()) or (found and not whole):
        expected, do = "a new folder, or one with an older report only", "choose a new folder"
        raise OutputError(refusal(f"--out {out}", expected=expected, got="other files in it", do=do))
