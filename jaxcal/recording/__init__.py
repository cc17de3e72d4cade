"""Recordings: what sensors wrote, read lazily, and the rig.yaml that ties them together."""

from jaxcal.recording.event_facts import EventFacts, event_facts
from jaxcal.recording.event_writers import convert_events, write_events
from jaxcal.recording.events import EventFile
from jaxcal.recording.formats.contract import EventColumns, Triggers
from jaxcal.recording.images import ImageFiles, load_frames
from jaxcal.recording.imu import load_imu, load_noise
from jaxcal.recording.rig import Rig, RigCamera, RigImu, load_rig
from jaxcal.recording.rig_reconstruction import RigReconstruction
from jaxcal.recording.tables import load_detections
from jaxcal.recording.windows import FrameTimes

__all__ = [
    "EventColumns",
    "EventFacts",
    "EventFile",
    "FrameTimes",
    "ImageFiles",
    "Rig",
    "RigCamera",
    "RigImu",
    "RigReconstruction",
    "Triggers",
    "convert_events",
    "event_facts",
    "load_detections",
    "load_frames",
    "load_imu",
    "load_noise",
    "load_rig",
    "write_events",
]
