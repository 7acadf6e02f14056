"""What the files say of themselves: lengths, sizes, remarks, and frames that show nothing."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence

from sphereorient.experiment import Experiment, outside_paths
from sphereorient.experiment.timeline import NONE, Timeline
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.preflight.look import Look
from sphereorient.trajectory import Reason

MANY = 0.5  # share of bad frames from which on a movie is no good
BALL_SEEN = 0.8  # share of the frames in which the ball should be found
STAYS = 0.5  # share of the frames in which a place may be covered by the ball


def clock(experiment: Experiment, timeline: Timeline) -> Finding:
    """Tell how long the experiment is, and what the timeline remarks."""
    count, title = len(timeline), "frames"
    measured = f"{count} of {', '.join(experiment.movie_paths)}"
    if count > 1:
        pace = f"{1 / timeline.frame_s:.6g} Hz" if timeline.even else f"uneven, usually {1 / timeline.frame_s:.6g} Hz"
        measured += f"; {timeline.time_s[-1] - timeline.time_s[0] + timeline.frame_s:.4g} s, {pace}"
    if not timeline.remarks:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    advice = "check start: and frames: if the cameras began and ended together"
    return Finding(
        title=title, severity=Severity.WARNING, measured="; ".join([measured, *timeline.remarks]), advice=advice
    )


def outside(experiment: Experiment) -> list[Finding]:
    """Tell which files lie outside of the experiment's folder."""
    paths = [os.path.relpath(path, experiment.folder) for path in outside_paths(experiment)]
    if not paths:
        return []
    measured = f"not in the folder of {experiment.path.name}: {', '.join(paths)}"
    advice = "make sure that these are meant, if the experiment came from somebody else"
    return [Finding(title="files elsewhere", severity=Severity.WARNING, measured=measured, advice=advice)]


def movie(look: Look) -> Finding:
    """Tell what is in a movie."""
    height, width = look.movie.frame_shape
    bits = f"{look.background.full_scale:.0f} the brightest level"
    measured = f"{look.movie.path.name}: {len(look.movie)} pictures of {width} x {height} px, {bits}"
    remarks = look.movie.remarks
    severity = Severity.WARNING if remarks else Severity.OK
    advice = "record or export the movie again if this is not meant" if remarks else ""
    measured = "; ".join([measured, *remarks])
    return Finding(title=f"movie {look.name}", severity=severity, measured=measured, advice=advice)


def pictures(looks: Sequence[Look]) -> Finding:
    """Tell which of the frames looked at cannot show the ball, whatever is in front of the camera.

    Args:
        looks: of one camera, frame after frame in each.
    """
    name = looks[0].name
    seen: dict[int, Reason] = {}
    for look in looks:
        # A frame that is in two of them is repeated where either knows its neighbour.
        seen |= {
            int(row): reason
            for row, reason in zip(look.row, look.screen, strict=True)
            if row != NONE and seen.get(int(row), Reason.OK) is Reason.OK
        }
    bad = {row: reason for row, reason in sorted(seen.items()) if reason is not Reason.OK}
    title = f"pictures {name}"
    if not bad:
        measured = f"{len(seen)} frames looked at: all readable, none black, white or repeated"
        return Finding(title=title, severity=Severity.OK, measured=measured)
    told = Counter(bad.values()).most_common()
    words = ", ".join(f"{count} {reason}" for reason, count in told)
    measured = f"of {len(seen)} frames looked at: {words} (the first: picture {next(iter(bad))} of the movie)"
    severity = Severity.FAULT if len(bad) > MANY * len(seen) else Severity.WARNING
    return Finding(title=title, severity=severity, measured=measured, advice=_REMEDY[told[0][0]])


def ball(look: Look) -> Finding:
    """Tell in how many frames the ball was found, and why not in the others."""
    usable = [k for k, reason in enumerate(look.screen) if reason in (Reason.OK, Reason.REPEATED)]
    reasons = Counter(look.found[k][1] for k in usable)
    title, seen = f"ball {look.name}", reasons.pop(Reason.OK, 0)
    measured = f"found in {seen} of {len(usable)} frames"
    if reasons:
        measured += " (" + ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()) + ")"
    if seen >= BALL_SEEN * len(usable) and seen:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    likely = reasons.most_common(1)[0][0] if reasons else Reason.NOT_FOUND
    severity = Severity.WARNING if seen else Severity.FAULT
    return Finding(title=title, severity=severity, measured=measured, advice=_REMEDY[likely])


_REMEDY = {
    Reason.UNDECODABLE: "export the movie again; the frames that cannot be decoded are left out of the track",
    Reason.DARK: "light the ball more, open the lens, or expose longer",
    Reason.SATURATED: "close the lens or expose shorter: white paint must stay below the brightest level",
    Reason.REPEATED: "export the movie without a change of frame rate; the repeated frames are left out of the track",
    Reason.NOT_FOUND: "check sphere.diameter, or set locate.diameter_px; give backgrounds: if the ball hardly moves",
    Reason.OUTLINE: "give backgrounds: pictures of the scene without the ball; check sphere.diameter and the light",
}


def empty_scene(look: Look, experiment: Experiment) -> Finding:
    """Tell whether the movie itself shows what is behind the ball."""
    title = f"background {look.name}"
    if look.name in experiment.background_paths:
        measured = f"given: {experiment.background_paths[look.name].name}"
        return Finding(title=title, severity=Severity.OK, measured=measured)
    advice = f"write backgrounds: {{{look.name}: FILE}}, a picture of the scene without the ball"
    if experiment.fixed:
        measured = "none given: behind a ball that is fixed is taken to be what lies around it"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    centres = [(outline.u_px, outline.v_px, outline.radius_px) for _, outline in look.balls]
    shares = [sum((u - x) ** 2 + (v - y) ** 2 < r**2 for x, y, r in centres) / len(centres) for u, v, _ in centres]
    share = max(shares, default=0.0)
    measured = f"learnt from the movie: the ball covers no place in more than {100 * share:.0f} % of the frames"
    if share <= STAYS:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
