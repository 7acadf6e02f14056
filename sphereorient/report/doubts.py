"""What is doubtful in a frame, in words: flags of the track, and why a camera has no orientation."""

from __future__ import annotations

from sphereorient.trajectory import Flag, Reason, Trajectory

FLAG_WORDS = {
    Flag.POSITION_INTERPOLATED: "position interpolated over a gap",
    Flag.POSITION_OUTLIER_REPLACED: "position was off and was replaced",
    Flag.ONE_CAMERA: "one camera only",
    Flag.REPAIRED_FROM_OTHER_CAMERA: "the cameras disagreed; one was repaired from the other",
    Flag.AMBIGUOUS: "another orientation fits nearly as well",
    Flag.DOUBTFUL_FIT: "picture explained less well than usual",
    Flag.RECOVERED: "found again after a loss",
    Flag.SPIKE: "the orientation jumps",
    Flag.EXTRAPOLATED: "not measured; the smoother's value",
}
REASON_WORDS = {
    Reason.OK: "measured",
    Reason.NOT_FOUND: "no ball found",
    Reason.OUTLINE: "no clear outline",
    Reason.DARK: "too dark",
    Reason.SATURATED: "too bright",
    Reason.REPEATED: "same picture as before",
    Reason.RUNAWAY: "too many possible orientations",
    Reason.LOW_SCORE: "no orientation explains the picture",
    Reason.AMBIGUOUS: "orientation ambiguous",
    Reason.CONTRADICTS: "contradicts the other camera",
    Reason.UNDECODABLE: "picture damaged",
    Reason.MISSING: "no picture",
}


def flag_words(track: Trajectory, k: int) -> list[str]:
    """Return the flags of frame k in words; that there is one camera is no news where the experiment has no other."""
    bits = int(track.flags[k])
    if len(track.cameras) < 2:
        bits &= ~Flag.ONE_CAMERA
    return [words for flag, words in FLAG_WORDS.items() if bits & flag]


def reason_words(track: Trajectory, k: int) -> dict[str, str]:
    """Return what every camera says of frame k, in words, by its name."""
    said = {name: camera.reason[k] for name, camera in track.cameras.items()}
    return {name: REASON_WORDS.get(Reason(why), why) if why in set(Reason) else str(why) for name, why in said.items()}


def lost_cameras(track: Trajectory, k: int) -> dict[str, str]:
    """Return why, by name, for the cameras that have no orientation in frame k."""
    words = reason_words(track, k)
    return {name: why for name, why in words.items() if track.cameras[name].reason[k] != Reason.OK}


def doubts(track: Trajectory, k: int) -> list[str]:
    """Return everything that is doubtful in frame k, in words; empty for a frame that is as it should be."""
    told = [] if track.valid[k] else ["not valid"]
    told += flag_words(track, k)
    return told + [f"{name}: {why}" for name, why in lost_cameras(track, k).items()]
