"""`jaxcal calibrate-imu-camera`: Kalibr's command for cameras and IMUs, over a bag or a folder that stands for one."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.kalibr_arguments import SHARED_NOT_NEEDED, VERBOSE, KalibrCommand, Many, all_of, not_needed
from jaxcal.cli.outcome import EXIT_CODES

if TYPE_CHECKING:
    import numpy as np

    from jaxcal.recording import Rig, RigImu
    from jaxcal.results import Calibration, CamchainCamera

_NOT_NEEDED = all_of(
    SHARED_NOT_NEEDED,
    not_needed("--time-calibration", "time offsets are always estimated."),
    not_needed(
        "--no-time-calibration",
        "time offsets are estimated all the same; where clocks agree, they come out as zero within their sigma.",
    ),
    not_needed(
        "--recompute-camera-chain-extrinsics",
        "the cameras' poses to each other are always estimated anew; how far they moved is said below.",
    ),
    not_needed("--reprojection-sigma", "the noise of corners is estimated from their residuals, per camera.", float),
    not_needed("--imu-delay-by-correlation", "the time offsets of further IMUs are always estimated."),
    not_needed("--recover-covariance", "every parameter comes with its sigma anyway."),
    not_needed("--timeoffset-padding", "the time offset is searched for over the whole recording.", float),
    not_needed("--extraction-stepping", "nothing is shown while detecting; the report shows corners on the images."),
    not_needed(
        "--perform-synchronization",
        "the times in the messages' headers are taken as they are, and the offset between sensors is estimated.",
    ),
)


@click.command("calibrate-imu-camera", cls=KalibrCommand, epilog=EXIT_CODES)
@click.option("--bag", required=True, type=click.Path(path_type=Path), help="Bag, or EuRoC folder, that holds all.")
@click.option(
    "--target", "target_file", required=True, type=click.Path(dir_okay=False, path_type=Path), help="target.yaml"
)
@click.option("--imu", "imu_files", cls=Many, required=True, help="imu.yaml of each IMU, the reference first.")
@click.option("--imu-models", cls=Many, help="One for all IMUs, or one each (calibrated).")
@click.option(
    "--cams",
    "--cam",
    "chain_file",
    type=click.Path(path_type=Path),
    help="camchain.yaml: lenses and topics of the cameras. Or give --topics and --models.",
)
@click.option("--topics", cls=Many, help="Without --cams, or in place of its topics: the topic of each camera.")
@click.option("--models", cls=Many, help="Without --cams: lens models; one for all cameras, or one each.")
@click.option(
    "--intrinsics",
    type=click.Choice(["held", "prior", "free"]),
    help="Lenses of --cams: held as Kalibr does (default), under their own uncertainty, or only a start.",
)
@click.option("--board-warp", is_flag=True, help="Estimate how the board is bent.")
@click.option("--imu-noise-estimated", is_flag=True, help="Use the noise that the residuals show, not imu.yaml's.")
@click.option("--bag-from-to", nargs=2, type=float, metavar="START END", help="Use this part only; s after the start.")
@click.option("--bag-freq", type=float, help="Use at most so many images a second.")
@click.option("--rolling-shutter", is_flag=True, help="Rows are seen one after another: estimate the delay.")
@click.option("--max-iter", type=int, help="Iterations at most (60).")
@click.option("--export-poses", is_flag=True, help="Write the motion of the IMU as a csv.")
@click.option("--workers", type=int, help="Processes for detection (one per core).")
@click.option(
    "--out",
    "--output",
    "-o",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results (BAG-jaxcal).",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@VERBOSE
@_NOT_NEEDED
@click.pass_context
def calibrate_imu_camera(ctx: click.Context, bag: Path, target_file: Path, out: Path | None, **given: Any) -> None:
    """Calibrate cameras and IMUs: poses, time offsets, gravity, biases, and IMU models.

    \b
    Kalibr's own command works with the program's name changed; bags may be of ROS 1, ROS 2 or mcap:
    jaxcal calibrate-imu-camera --bag imucam.bag --cam cams-camchain.yaml --imu imu.yaml --target april.yaml
    jaxcal calibrate-imu-camera --bag imucam.bag --cam cams-camchain.yaml --imu imu0.yaml imu1.yaml \\
        --imu-models calibrated scale-misalignment --target april.yaml --bag-from-to 5 45 --time-calibration

    \b
    Without an earlier calibration of the cameras, lenses and all in one go:
    jaxcal calibrate-imu-camera --bag imucam.bag --topics /cam0/image_raw --models pinhole-radtan \\
        --imu imu.yaml --target april.yaml

    \b
    A folder may stand for a bag; /cam0/image_raw is then its cam0/ (or mav0/cam0/), /imu0 its imu0/data.csv:
    jaxcal calibrate-imu-camera --bag euroc/ --topics /cam0 /cam1 --imu imu.yaml --target april.yaml

    Topics come from `rostopic` in imu.yaml and in the camchain. The folder BAG-jaxcal/ (--out names another) gets
    Kalibr's files by Kalibr's names (imucam-camchain-imucam.yaml, imucam-results-imucam.txt, imucam-imu.yaml), which
    overwrite nothing that Kalibr left beside the bag, and report.html and calibration.npz.
    """
    from jaxcal.cli.kalibr_output import bag_tag, output_folder, write_kalibr_files
    from jaxcal.cli.outcome import show_calibration
    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.pipeline import PipelineSettings, run_pipeline
    from jaxcal.results import load_camchain

    _check_usage(ctx, given)
    out = out or output_folder(bag)
    chain_file = given["chain_file"]
    earlier = _earlier(chain_file, target_file)
    chain = load_camchain(chain_file) if earlier is not None and not chain_file.is_dir() else ()
    topics = _topics(ctx, chain, earlier, given)
    rig, imu_topics = _rig(bag, target_file, topics, earlier, given)
    options: dict[str, Any] = {} if given["max_iter"] is None else {"max_steps": given["max_iter"]}
    options |= {"board_warp": True} if given["board_warp"] else {}
    options |= {"imu_noise": "estimated"} if given["imu_noise_estimated"] else {}
    if earlier is not None:
        options |= {"cameras": earlier, "intrinsics": given["intrinsics"] or "held"}
    settings = PipelineSettings(cache=out / "cache", camera_imu=options)
    with ProgressBars() as bars:
        calibration = run_pipeline(rig, out, settings=settings, workers=given["workers"], progress=bars)
    files = write_kalibr_files(calibration, out, bag_tag(bag), topics, imu_topics, poses=given["export_poses"])
    if earlier is not None:
        _say_what_moved(calibration, earlier)
    ctx.exit(show_calibration(calibration, out, as_json=given["as_json"], files=files))


def _check_usage(ctx: click.Context, given: dict[str, Any]) -> None:
    if given["chain_file"] is None:
        if not given["topics"]:
            raise click.UsageError("missing --cams camchain.yaml, or --topics with --models.", ctx)
        if given["intrinsics"] is not None:
            raise click.UsageError("--intrinsics is about the lenses of --cams.", ctx)
    elif given["models"]:
        raise click.UsageError("--models come from --cams; leave one of the two out.", ctx)
    for name, values, count in (
        ("models", given["models"], len(given["topics"])),
        ("imu-models", given["imu_models"], len(given["imu_files"])),
    ):
        if values and len(values) not in (1, count):
            raise click.UsageError(f"{len(values)} --{name} for {count}; give one for all, or one each.", ctx)


def _earlier(chain_file: Path | None, target_file: Path) -> "Calibration | None":
    from jaxcal import load_target
    from jaxcal.results.interchange import calibration_of_file

    return None if chain_file is None else calibration_of_file(chain_file, load_target(target_file))


def _topics(
    ctx: click.Context, chain: "tuple[CamchainCamera, ...]", earlier: "Calibration | None", given: dict[str, Any]
) -> list[str]:
    """The topic of each camera, from the arguments or the camchain."""
    if earlier is None:
        return list(given["topics"])
    count = len(earlier.cameras)
    topics = list(given["topics"]) or [camera.rostopic for camera in chain]
    if len(topics) != count or None in topics:
        raise click.UsageError(
            f"{given['chain_file']} has {count} cameras, but names {sum(t is not None for t in topics)} topics; give "
            "--topics, one for each.",
            ctx,
        )
    return [str(topic) for topic in topics]


def _rig(
    bag: Path, target_file: Path, topics: list[str], earlier: "Calibration | None", given: dict[str, Any]
) -> "tuple[Rig, list[str | None]]":
    """What the arguments name, as a rig.yaml would, and the IMUs' topics."""
    from jaxcal import camera_model, load_target
    from jaxcal.cameras import model_name
    from jaxcal.recording import Rig, RigCamera
    from jaxcal.recording.sources import camera_source

    if earlier is not None:
        models = [model_name(camera.model) for camera in earlier.cameras]
    else:
        models = list(given["models"] or ["pinhole-radtan"])
        models = models * len(topics) if len(models) == 1 else models
    for model in models:
        camera_model(model)  # an unknown one is reported now
    imus, imu_topics = _imus(bag, given)
    cameras = []
    for number, (topic, model) in enumerate(zip(topics, models, strict=True)):
        source = camera_source(bag, topic)
        common: dict[str, Any] = {"name": f"cam{number}", "model": model, source.kind: source.place}
        cameras.append(RigCamera(**common, rolling_shutter=given["rolling_shutter"]))
    rig = Rig(
        path=target_file,
        target=load_target(target_file),
        cameras=tuple(cameras),
        imus=imus,
        from_to=given["bag_from_to"],
        frame_rate_hz=given["bag_freq"],
    )
    return rig, imu_topics


def _imus(bag: Path, given: dict[str, Any]) -> "tuple[tuple[RigImu, ...], list[str | None]]":
    from jaxcal.errors import CalibrationError
    from jaxcal.imu import imu_model
    from jaxcal.recording import RigImu, load_noise
    from jaxcal.recording.sources import imu_source
    from jaxcal.recording.yaml_files import read_mapping

    files = [Path(name) for name in given["imu_files"]]
    models = list(given["imu_models"] or ["calibrated"])
    models = models * len(files) if len(models) == 1 else models
    imus, topics = [], []
    for file, model in zip(files, models, strict=True):
        noise = load_noise(file)
        content = read_mapping(file, "imu.yaml")
        topic = content.get("imu0", content).get("rostopic")
        try:
            source = imu_source(bag, topic)
        except CalibrationError as error:
            if topic is None:
                raise
            raise CalibrationError(f"{error} The topic comes from 'rostopic' in {file}: correct it there.") from error
        imus.append(RigImu(source, noise, imu_model(model).name))
        topics.append(topic)
    return tuple(imus), topics


def _say_what_moved(calibration: "Calibration", earlier: "Calibration") -> None:
    """How far the cameras' poses to each other are from the camchain's, which Kalibr would have held."""
    from jaxcal.cli.kalibr_arguments import note

    for now, before in zip(calibration.cameras, earlier.cameras, strict=True):
        if now.T_cn_cnm1 is not None and before.T_cn_cnm1 is not None:
            turn_deg, shift_m = _between(now.T_cn_cnm1, before.T_cn_cnm1)
            note(
                f"{now.name}'s pose to the camera before was estimated anew: {turn_deg:.3f} deg and "
                f"{1e3 * shift_m:.2f} mm from the camchain's."
            )


def _between(a: "np.ndarray", b: "np.ndarray") -> tuple[float, float]:
    """The angle (deg) and the distance (m) between two poses."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
