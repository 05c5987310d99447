"""Synthetic renderings: scenes, camera paths and frames with exact ground truth, endless, from a seed."""

from dvo.synth.clip import Clip, ClipSpec, make_clip
from dvo.synth.meshes.files import load_mesh, mesh_scene
from dvo.synth.meshes.mesh import MeshScene
from dvo.synth.motion.motion import Path, SplinePath
from dvo.synth.motion.natural import NATURAL_KINDS, natural_path
from dvo.synth.motion.paths import KINDS, random_path
from dvo.synth.motion.walks import LONG_KINDS, long_path
from dvo.synth.render.quality import Quality
from dvo.synth.render.renderer import Rendering, render, trace
from dvo.synth.render.shot import Shot
from dvo.synth.scenes.bodies import Body, Stage
from dvo.synth.scenes.families import FAMILIES, HELD_OUT, random_scene
from dvo.synth.scenes.scene import Scene
from dvo.synth.sensors.imu import Imu, ImuNoise, measure_imu
from dvo.synth.sensors.sensor import Sensor
from dvo.synth.sequence import SyntheticSequence, film, make_sequence
from dvo.synth.specs import CameraSpec, MotionSpec, SceneSpec, SequenceFormat, SequenceSpec, sequence_spec
from dvo.synth.truth import Flow, Tracks, dynamic_mask, optical_flow, tracks

__all__ = [
    "FAMILIES", "HELD_OUT", "KINDS", "LONG_KINDS", "NATURAL_KINDS", "Body", "CameraSpec", "Clip", "ClipSpec",
    "Flow", "Imu", "ImuNoise", "MeshScene", "MotionSpec", "Path", "Quality", "Rendering", "Scene", "SceneSpec",
    "Sensor", "SequenceFormat", "SequenceSpec", "Shot", "SplinePath", "Stage", "SyntheticSequence", "Tracks",
    "dynamic_mask", "film", "load_mesh", "long_path", "make_clip", "make_sequence", "measure_imu", "mesh_scene",
    "natural_path", "optical_flow", "random_path", "random_scene", "render", "sequence_spec", "trace", "tracks",
]  # fmt: skip
