"""The files that Kalibr would have written, by Kalibr's names and with the topics' names in them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from jaxcal.cli.kalibr_arguments import note

if TYPE_CHECKING:
    import numpy as np

    from jaxcal.results import Calibration

_POSES_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"  # as Kalibr
)


def bag_tag(bag: Path) -> str:
    """What Kalibr's files of a bag start with: its name without the suffix."""
    return bag.stem if bag.suffix else bag.name


def output_folder(bag: Path) -> Path:
    """Where results go when nobody says: BAG-jaxcal beside the bag, so that nothing of Kalibr's is overwritten."""
    import os

    beside = bag.resolve().parent
    parent = beside if os.access(beside, os.W_OK) else Path()
    return parent / f"{bag_tag(bag)}-jaxcal"


def write_kalibr_files(
    calibration: "Calibration",
    folder: Path,
    tag: str,
    topics: Sequence[str | None],
    imu_topics: Sequence[str | None] = (),
    poses: bool = False,
) -> dict[str, Path]:
    """TAG-camchain.yaml and its companions in `folder`, by what they are; the poses over time on demand."""
    from jaxcal.atomic import write_text
    from jaxcal.cameras import model_name
    from jaxcal.results.interchange import rig_of
    from jaxcal.results.interchange.kalibr_files import KALIBR_MODELS
    from jaxcal.results.interchange.kalibr_text import results_files
    from jaxcal.results.kalibr import chain_content, imu_entries, to_yaml

    cameras = tuple(
        camera if topic is None else replace(camera, rostopic=topic)
        for camera, topic in zip(rig_of(calibration).cameras, topics, strict=True)
    )
    suffix = "" if calibration.imu is None else "-imucam"
    files = {"camchain": (f"{tag}-camchain{suffix}.yaml", to_yaml(chain_content(cameras)))}
    if calibration.imus:
        entries = imu_entries(calibration.imus)
        for entry, topic in zip(entries.values(), imu_topics, strict=True):
            entry |= {} if topic is None else {"rostopic": topic}
        files["imu"] = (f"{tag}-imu.yaml", to_yaml(entries))
    own = [camera.name for camera in calibration.cameras if model_name(camera.model) not in KALIBR_MODELS]
    if own:
        note(f"Kalibr does not know the models of {', '.join(own)}: the camchain is for jaxcal, and no results text.")
    else:
        ((name, text),) = results_files(calibration).items()
        files["results"] = (f"{tag}-{name}", text)
    if poses:
        sensor = "-imucam-imu0" if calibration.imus else "-cam0"
        files["poses"] = (f"{tag}-poses{sensor}.csv", poses_csv(calibration))
    for name, text in files.values():
        write_text(folder / name, text)
    return {what: folder / name for what, (name, _) in files.items()}


def poses_csv(calibration: "Calibration") -> str:
    """The pose of the first IMU, or of the first camera, in the target's frame over time: Kalibr's columns."""
    import numpy as np

    if calibration.imu is not None:
        imu = calibration.imu
        times = imu.origin_ns + np.round(imu.t_s * 1e9).astype(np.int64)
        return _table(times, imu.position_m, imu.rotation)
    camera = calibration.cameras[0]
    known = np.empty((0, 4, 4)) if camera.T_cam_target is None else camera.T_cam_target
    seen = np.flatnonzero(np.isfinite(known).all(axis=(1, 2)))
    T_target_cam = np.linalg.inv(known[seen])
    return _table(camera.detections.timestamps_ns[seen], T_target_cam[:, :3, 3], T_target_cam[:, :3, :3])


def _table(times_ns: "np.ndarray", positions: "np.ndarray", rotations: "np.ndarray") -> str:
    from scipy.spatial.transform import Rotation

    lines = [_POSES_HEADER]
    if len(times_ns):
        turns = Rotation.from_matrix(rotations).as_quat(canonical=True)[:, [3, 0, 1, 2]]
        for time, position, turn in zip(times_ns, positions, turns, strict=True):
            lines.append(",".join([str(int(time)), *(f"{value:.6f}" for value in (*position, *turn))]))
    return "\n".join(lines) + "\n"
