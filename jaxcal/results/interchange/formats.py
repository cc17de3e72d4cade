"""`read_calibration` and `write_calibration`: the formats of other tools behind one contract."""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxcal.atomic import write_text
from jaxcal.errors import CalibrationError
from jaxcal.results.calibration import Calibration
from jaxcal.results.files import FILE_NAME, load_calibration
from jaxcal.results.interchange import basalt, colmap, kalibr_files, kalibr_text, opencv, ros, vins
from jaxcal.results.interchange.documents import SUFFIXES, Document, read_document
from jaxcal.results.interchange.lenses import require_known
from jaxcal.results.interchange.rig import CalibratedRig, rig_of

logger = logging.getLogger(__name__)

_POSES, _IMU_POSE, _TIME, _NOISE = "poses between cameras", "poses to the IMU", "time offsets", "the IMU's noise"


@dataclass(frozen=True)
class Format:
    """A format of files: what it is called, which models it holds, and what of a rig (`loses`) it does not.

    `write` gives the files' content by name, the first of which can stand alone where `first_alone`. `texts` are files
    that only a calibration with its measurements can fill.
    """

    title: str
    models: tuple[str, ...]
    recognises: Callable[[Document], bool]
    read: Callable[[list[Document]], CalibratedRig]
    write: Callable[[CalibratedRig], tuple[dict[str, str], tuple[str, ...]]]
    loses: tuple[str, ...] = ()
    first_alone: bool = False
    texts: Callable[[Calibration], dict[str, str]] | None = None


FORMATS: dict[str, Format] = {
    "kalibr": Format(
        "Kalibr",
        kalibr_files.KALIBR_MODELS,
        kalibr_files.recognises_kalibr,
        kalibr_files.read,
        kalibr_files.write_kalibr,
        first_alone=True,
        texts=kalibr_text.results_files,
    ),
    "openvins": Format(
        "OpenVINS",
        kalibr_files.OPENVINS_MODELS,
        kalibr_files.recognises_openvins,
        kalibr_files.read,
        kalibr_files.write_openvins,
        first_alone=True,
    ),
    "vins": Format("VINS-Fusion", vins.MODELS, vins.recognises, vins.read, vins.write),
    "basalt": Format("Basalt", basalt.MODELS, basalt.recognises, basalt.read, basalt.write),
    "ros": Format("ROS", ros.MODELS, ros.recognises, ros.read, ros.write, (_POSES, _IMU_POSE, _TIME, _NOISE)),
    "opencv": Format("OpenCV", opencv.MODELS, opencv.recognises, opencv.read, opencv.write, (_NOISE,)),
    "colmap": Format(
        "COLMAP", colmap.MODELS, colmap.recognises, colmap.read, colmap.write, (_POSES, _IMU_POSE, _TIME, _NOISE)
    ),
}


@dataclass(frozen=True)
class Written:
    """The files written, and sentences about what of the rig they do not hold."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...]


def write_calibration(calibration: Calibration | CalibratedRig, path: str | Path, format: str) -> Written:
    """Write a calibration in a format of another tool: kalibr, openvins, vins, basalt, ros, opencv or colmap.

    `path` is a folder, or, where it ends in .yaml, .yml, .json or .txt, the file itself: that of the cameras where a
    format has a second one for the IMU. Existing files are replaced, each atomically. Uncertainty and measurements are
    in no such file; what else is lost is in `Written.notes`.

    Raises CalibrationError when the format is unknown, cannot hold a lens or the rig, or needs a folder.
    """
    rig = rig_of(calibration) if isinstance(calibration, Calibration) else calibration
    chosen = _format(format)
    if not rig.cameras:
        raise CalibrationError(f"{path}: there is no camera to write; the file read describes an IMU only.")
    for camera in rig.cameras:
        require_known(camera.model, chosen.models, chosen.title, camera.name)
    files, notes = chosen.write(rig)
    if chosen.texts is not None and isinstance(calibration, Calibration):
        files |= chosen.texts(calibration)
    placed, more = _placed(files, Path(path), chosen)
    notes = (*notes, *more, *_lost(rig, chosen))
    for place, text in placed.items():
        write_text(place, text)
    for note in notes:
        logger.info("%s: %s", path, note)
    return Written(tuple(placed), notes)


def read_calibration(path: str | Path) -> CalibratedRig:
    """Read a calibration of whatever format, found out from its content, from a file or from a folder of files.

    Of Kalibr, OpenVINS, VINS-Fusion, Basalt, ROS, OpenCV, COLMAP and jaxcal. Raises CalibrationError when the file is
    missing, damaged, of no format known or of an unknown lens, and when a folder holds several calibrations.
    """
    path = Path(path)
    if not path.exists():
        raise CalibrationError(f"{path}: no such file or folder.")
    if _is_ours(path):
        return rig_of(load_calibration(path))
    if path.is_dir():
        name, documents = _format_of_folder(path)
    else:
        document = read_document(path)
        name, documents = _format_of(document), [document]
    if name is None and kalibr_text.is_results_text(documents[0].content if documents else None):
        raise CalibrationError(
            f"{path}: Kalibr's results text does not say the image size. Read the camchain beside it, or the text with "
            "`jaxcal.results.interchange.read_kalibr_results`."
        )
    if name is None:
        raise CalibrationError(
            f"{path}: not a calibration that is known here. Known are the files of "
            f"{', '.join(format.title for format in FORMATS.values())}, and the folders of jaxcal."
        )
    try:
        return FORMATS[name].read(documents)
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, ArithmeticError) as error:
        raise CalibrationError(
            f"{path}: the content is damaged ({type(error).__name__}: {error}). Write it again with "
            f"{FORMATS[name].title} or whatever made it."
        ) from error


def load_calibration_or_rig(path: str | Path) -> Calibration | CalibratedRig:
    """A calibration of ours with all it knows, or what a file of another tool says. Raises as `read_calibration`."""
    path = Path(path)
    return load_calibration(path) if _is_ours(path) else read_calibration(path)


def _is_ours(path: Path) -> bool:
    return path.suffix == ".npz" or (path / FILE_NAME).is_file()


def _format(name: str) -> Format:
    if name not in FORMATS:
        raise CalibrationError(f"format '{name}' is unknown. Known: {', '.join(FORMATS)}.")
    return FORMATS[name]


def _placed(files: dict[str, str], path: Path, format: Format) -> tuple[dict[Path, str], tuple[str, ...]]:
    """Content by the path it goes to, and what to say of content that goes nowhere."""
    if path.suffix not in SUFFIXES or path.is_dir():
        return {path / name: text for name, text in files.items()}, ()
    if len(files) > 1 and not format.first_alone:
        raise CalibrationError(
            f"{path}: {format.title} takes several files here ({', '.join(files)}). Name a folder instead."
        )
    first, *others = files
    expected = Path(first).suffix
    if path.suffix != expected and not {path.suffix, expected} <= {".yaml", ".yml"}:
        raise CalibrationError(f"{path}: files for {format.title} end in {expected}. Name the file so, or a folder.")
    return {path: files[first]}, tuple(f"{name} is written where a folder is named" for name in others)


def _lost(rig: CalibratedRig, format: Format) -> tuple[str, ...]:
    known = {
        _POSES: any(camera.T_cn_cnm1 is not None for camera in rig.cameras),
        _IMU_POSE: any(camera.T_cam_imu is not None for camera in rig.cameras),
        _TIME: any(camera.timeshift_cam_imu is not None for camera in rig.cameras),
        _NOISE: rig.imu is not None,
    }
    lost = [what for what in format.loses if known[what]]
    return (f"files for {format.title} do not hold {', '.join(lost)}",) if lost else ()


def _format_of(document: Document) -> str | None:
    return next((name for name, format in FORMATS.items() if format.recognises(document)), None)


def _format_of_folder(folder: Path) -> tuple[str | None, list[Document]]:
    """The one format of the files in a folder, and those files in the order of the numbers in their names."""
    found: dict[str, list[Document]] = {}
    for path in sorted((p for p in folder.iterdir() if p.suffix in SUFFIXES), key=_natural):
        try:
            document = read_document(path)
        except CalibrationError as error:
            logger.debug("passed over: %s", error)
            continue
        name = _format_of(document)
        if name is not None:
            found.setdefault(name, []).append(document)
    if len(found) > 1:
        files = "; ".join(f"{name}: {', '.join(d.path.name for d in documents)}" for name, documents in found.items())
        raise CalibrationError(f"{folder}: calibrations of several formats ({files}). Name the file.")
    for name, documents in found.items():
        return name, documents
    return None, []


def _natural(path: Path) -> list[tuple[int, int | str]]:
    """Names in the order in which a person counts: cam2 before cam10."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part)) if part.isdigit() else (0, part) for part in parts]
