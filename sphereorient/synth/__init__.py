"""Movies with truth: random motion, random paint, and the scene that two cameras see."""

from sphereorient.synth.motion import Motion6D, RandomMotion, random_motion
from sphereorient.synth.scene import Scene, make_scene, render_frame
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.textures import random_texture
from sphereorient.synth.write import write_experiment

__all__ = [
    "Motion6D",
    "RandomMotion",
    "Scene",
    "SynthSettings",
    "make_scene",
    "random_motion",
    "random_texture",
    "render_frame",
    "write_experiment",
]
