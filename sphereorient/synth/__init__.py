"""Synthetic movies with exact truth: random motion and paint, the scene of one to four cameras, degradations."""

from sphereorient.sphere.texture import random_texture
from sphereorient.synth.degrade import degrade
from sphereorient.synth.motion import Motion6D, RandomMotion, random_motion
from sphereorient.synth.scene import RenderedScene, make_scene, render_frame
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.severities import DEGRADATIONS, severity
from sphereorient.synth.write import write_degraded, write_synthetic_experiment
