"""Simulated rigs with exact ground truth: motion, measurements, rendered frames and events."""

import importlib
from typing import TYPE_CHECKING, Any

# Loaded when first asked for: the event sensor alone must not pull in the renderer.
_EXPORTS = {
    "Imaging": "rig",
    "Motion": "motion",
    "SimulatedCamera": "rig",
    "SimulatedRig": "rig",
    "paper_rig": "rig",
    "swinging_motion": "rig",
    "ImuTruth": "measurements",
    "simulate_detections": "measurements",
    "simulate_imu": "measurements",
    "EventSensor": "event_sensor",
    "EventSensorConfig": "event_sensor",
    "write_recording": "recordings",
}

__all__ = [
    "EventSensor",
    "EventSensorConfig",
    "Imaging",
    "ImuTruth",
    "Motion",
    "SimulatedCamera",
    "SimulatedRig",
    "paper_rig",
    "simulate_detections",
    "simulate_imu",
    "swinging_motion",
    "write_recording",
]

if TYPE_CHECKING:
    from jaxcal.simulation.event_sensor import EventSensor, EventSensorConfig
    from jaxcal.simulation.measurements import ImuTruth, simulate_detections, simulate_imu
    from jaxcal.simulation.motion import Motion
    from jaxcal.simulation.recordings import write_recording
    from jaxcal.simulation.rig import Imaging, SimulatedCamera, SimulatedRig, paper_rig, swinging_motion


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"jaxcal.simulation.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module 'jaxcal.simulation' has no attribute '{name}'")
