"""Recordings: what sensors wrote, read lazily, and the rig.yaml that ties them together."""

from jaxcal.recording.events import EventFile
from jaxcal.recording.images import ImageFiles, load_frames
from jaxcal.recording.imu import load_imu, load_noise
from jaxcal.recording.rig import Rig, RigCamera, RigImu, RigReconstruction, load_rig
from jaxcal.recording.tables import load_detections

__all__ = [
    "EventFile",
    "ImageFiles",
    "Rig",
    "RigCamera",
    "RigImu",
    "RigReconstruction",
    "load_detections",
    "load_frames",
    "load_imu",
    "load_noise",
    "load_rig",
]
