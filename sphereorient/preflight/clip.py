"""A short clip of an experiment, tracked again while circle, mask, light and field of view are changed by hand."""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sphereorient.cameras.response import Response
from sphereorient.experiment.experiment import Experiment, input_error
from sphereorient.experiment.recording import given_mask, open_recording
from sphereorient.files.page_server import Json
from sphereorient.files.threads import silent
from sphereorient.locate.background import full_scale_of
from sphereorient.locate.scene import fixed_ball
from sphereorient.mapping.adjustment import adjusted
from sphereorient.mapping.disks import held_place
from sphereorient.mapping.first_pass import CoarserPictures, FirstPass, swept
from sphereorient.methods.method import one_thread
from sphereorient.methods.settings import Settings
from sphereorient.movies import Grey, flipped_picture
from sphereorient.pose.poses import supported

FRAMES, APART, TOGETHER = 200, 4, 50  # frames of the clip; step of those used for the circle; adjusted together


class Clip:
    """The first frames of an experiment's movies, in memory. Raises ExperimentError: the ball moves."""

    def __init__(self, experiment: Experiment) -> None:
        if not experiment.alone or not experiment.fixed:
            do = "track it with `sphereorient track`"
            raise input_error(f"{experiment.path}, sphere.fixed", "one fixed ball", "another", do)
        with open_recording(experiment, textured=False) as recording:
            self._frame_s = recording.timeline.frame_s
            rows = zip(*(one.pictures(0, FRAMES) for one in recording.streams), strict=True)
            read = [tuple(one for one, _ in row if one is not None) for row in rows]
            whole = [row for row in read if len(row) == len(recording.streams)]  # the cameras stay in step
            if not whole:
                got, do = "none", "correct start:, or export the movies again"
                raise input_error(f"{experiment.path}, movies", "frames with a picture of each camera", got, do)
            names = [one.name for one in recording.streams]
            self.pictures = dict(zip(names, zip(*whole, strict=True), strict=True))

    def tracked(self, experiment: Experiment) -> Json:
        """Track the clip with circles, masks, response and cameras of another experiment, by the first pass without
        a map; adjust position and map. Return the numbers for the page. Raises SphereOrientError: no ball, or no
        rotation.
        """
        begun, settings = time.perf_counter(), Settings()
        with tempfile.TemporaryDirectory() as folder:
            paths = {name: Path(folder, f"{name}.npy") for name in self.pictures}
            shown = {name: in_light(each, experiment.response.get(name)) for name, each in self.pictures.items()}
            for name, lit in shown.items():
                np.save(paths[name], np.array([flipped_picture(one, experiment.flip.get(name, "none")) for one in lit]))
            masks = {name: given_mask(experiment, name, lit[0].shape) for name, lit in shown.items()}
            circles = {
                one: experiment.circles.get(one)
                or fixed_ball(np.array(lit[::APART]), settings.locate, None, masks[one])[0].circle
                for one, lit in shown.items()
            }
            clip = replace(experiment, movie_paths=paths, frame_rate_hz=1 / self._frame_s, times=None, frames=None)
            start = dict.fromkeys(paths, 0)
            clip = replace(clip, circles=circles, start=start, start_given=False, response={}, background_paths={})
            with open_recording(clip, textured=False) as recording, one_thread():
                place = held_place(recording, settings.paint, settings.locate)
                coarse, count = CoarserPictures.of(place), len(recording.timeline)
                found, kept = swept(recording, coarse, FirstPass(coarse.place), count, silent)
                left = adjusted(*kept.crops(TOGETHER)).left
        seen = [one for one in found if supported(one)]
        variance = [float(one.covariance[0, :3, :3].trace()) for one in seen]
        return {
            "frames": count,
            "found": len(seen),
            "score": float(np.median([float(one.score[0, one.use].mean()) for one in seen])),
            "error_deg": float(np.degrees(np.sqrt(np.median(variance)))),
            "left": 100 * left,
            "circles": circles,
            "seconds": time.perf_counter() - begun,
        }


def in_light(pictures: Sequence[Grey], response: Response | None) -> Sequence[Grey]:
    """Return the pictures of a camera in light, by its response; as they are if it is linear or unknown."""
    if response is None or response.linear:
        return pictures
    full = full_scale_of(np.array([one.max() for one in pictures]))
    return [(response.light(one, full) * (65535 / full)).round().astype(np.uint16) for one in pictures]
