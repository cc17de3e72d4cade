"""`jaxcal reconstruct`, also `python -m reconstruction`: frames from events."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from jaxcal.recording import EventFile, FrameTimes
    from jaxcal.recording.windows import WindowPlan

_WINDOW_MS = 33.0
_NOTE = "frames.json"
_FILE = click.Path(path_type=Path)

# What e2calib and rpg_e2vid take for their windows on the screen; accepted so that their command lines go on working.
_SCREEN_FLAGS = ("--display", "--no-display_trackbars", "--no-show_reconstruction", "--show_events")
_SCREEN_VALUES = (
    "--event_display_mode",
    "--num_bins_to_show",
    "--display_border_crop",
    "--display_wait_time",
    "--gamma",
    "--contrast",
    "--brightness",
    "--saturation",
)


def _for_the_screen(command: Any) -> Any:
    for name in _SCREEN_FLAGS:
        command = click.option(name, is_flag=True, hidden=True, expose_value=False)(command)
    for name in _SCREEN_VALUES:
        command = click.option(name, hidden=True, expose_value=False)(command)
    return command


# `--no-normalize` and `--no_normalize`: hyphens and underscores are one.
@click.command(context_settings={"token_normalize_func": lambda name: name.replace("-", "_"), "max_content_width": 110})
@click.argument("source", metavar="[EVENTS]", required=False)
@click.option("--h5file", "--input_file", "-i", "named_source", hidden=True)
@click.option("--output", "--out", type=_FILE, help="Folder for the frames: data.csv and data/<time in ns>.png.")
@click.option("--output_folder", "-o", type=_FILE, help="As e2calib: the frames go to its subfolder --dataset_name.")
@click.option("--dataset_name", default="e2calib", show_default=True, help="See --output_folder.")
@click.option("--overwrite", is_flag=True, help="Take the place of other frames in the folder.")
@click.option("--bag", type=_FILE, help="Write the images to a bag, too: OUT.bag (ROS 1), else a ROS 2 bag.")
@click.option("--topic", default="/cam0/image_raw", show_default=True, help="Topic of the images in the bag.")
@click.option("--width", type=click.IntRange(1), help="Columns of the sensor, where the file does not tell.")
@click.option("--height", type=click.IntRange(1), help="Rows of the sensor, where the file does not tell.")
@click.option("--freq_hz", "-fhz", type=float, default=0.0, help="So many frames a second, from the first event on.")
@click.option(
    "--timestamps_file", "-tsf", type=_FILE, help="Frames at these times: a text file, microseconds per line."
)
@click.option("--triggers", type=click.Choice(["rising", "falling", "middle"]), help="Frames at external triggers.")
@click.option("--trigger_channel", type=int, help="Which trigger input, where there are several.")
@click.option("--stamps_of", help="Frames at the times of these images: an EuRoC folder, or a topic of a bag.")
@click.option("--time_offset_us", type=float, default=0.0, help="Added to the times given; half an exposure, say.")
@click.option(
    "--imu", help="Frames as often as a camera-IMU spline wants them: the IMU's readings (csv, npz, or a bag's topic)."
)
@click.option("--window_duration", "-T", type=float, help="A frame per so many milliseconds (33, if nothing is said).")
@click.option("--window_size", "-N", type=click.IntRange(1), help="A frame per so many events.")
@click.option("--num_events_per_pixel", type=float, help="A frame per so many events for each pixel; E2VID's is 0.35.")
@click.option("--fixed_duration", is_flag=True, hidden=True)
@click.option(
    "--upsample_rate", "-u", type=click.IntRange(1), default=1, help="So many windows for each frame that is kept."
)
@click.option("--path_to_model", "--network", "-c", help="Weights, or the name of a network that jaxcal ships.")
@click.option("--use_gpu", is_flag=True, help="Compute on --gpu_id; the same as --device cuda:0.")
@click.option("--gpu_id", type=int, default=0)
@click.option("--device", help="cpu, cuda, cuda:1, auto ...  [cpu]")
@click.option("--use_fp16", is_flag=True, help="The same as --precision float16; GPUs only.")
@click.option(
    "--precision", type=click.Choice(["auto", "float32", "bfloat16", "float16"]), default="auto", show_default=True
)
@click.option("--hot_pixels", type=click.Choice(["auto"]), help="Find pixels that fire all the time, and ignore them.")
@click.option("--hot_pixels_file", type=_FILE, help="Pixels to ignore: lines 'x,y'.")
@click.option("--unsharp_mask_amount", type=float, default=0.3, show_default=True)
@click.option("--unsharp_mask_sigma", type=float, default=1.0, show_default=True)
@click.option("--bilateral_filter_sigma", type=float, default=0.0, show_default=True)
@click.option("--flip", is_flag=True, help="Turn the images by half a turn.")
@click.option("--Imin", "Imin", type=float, default=0.0, show_default=True, help="Network output that becomes black.")
@click.option("--Imax", "Imax", type=float, default=1.0, show_default=True, help="Network output that becomes white.")
@click.option("--auto_hdr", is_flag=True, help="Take black and white from the images instead.")
@click.option("--auto_hdr_median_filter_size", type=click.IntRange(1), default=10, show_default=True)
@click.option("--color", is_flag=True, help="Colour images of a sensor with Bayer filters RGGB (DAVIS346 colour).")
@click.option("--bayer", type=click.Choice(["rggb", "bggr", "grbg", "gbrg"]), help="The same, for other filters.")
@click.option("--no-normalize", "no_normalize", is_flag=True, help="Leave voxel grids unscaled.")
@click.option("--no-recurrent", "no_recurrent", is_flag=True, help="Forget everything after each window.")
@click.option("--verbose", "-v", is_flag=True, help="Say more of what is done.")
@click.option("--json", "as_json", is_flag=True, help="The summary as one JSON object.")
@_for_the_screen
def reconstruct(source: str | None, named_source: str | None, **options: Any) -> None:
    """Reconstruct frames from events, to detect a calibration target in them.

    \b
    jaxcal reconstruct recording.raw --output frames/
    jaxcal reconstruct events.h5 --width 640 --height 480 --freq_hz 5 --upsample_rate 4 --output frames/
    jaxcal reconstruct drive.bag:/dvs/events --stamps_of drive.bag:/cam0/image_raw --output frames/
    jaxcal reconstruct recording.raw --triggers middle --hot_pixels auto --output frames/ --bag frames.bag
    jaxcal reconstruct recording.raw --imu imu0/data.csv --output frames/
    jaxcal calibrate-cameras frames/ --target board.yaml --out result

    EVENTS is any event recording that `jaxcal info` knows. A frame carries the moment that it shows: the middle of
    its window [t0, t1), or the end (networks patterns_v1, E2VID, FireNet). Every event up to the last window's end is
    in exactly one window. At given times, a window that is much longer than usual is divided.

    The folder appears when it is complete; a run that was killed starts anew, one that had finished is not repeated.

    Takes the options of e2calib's offline_reconstruction.py and of rpg_e2vid's run_reconstruction.py under their names
    (--h5file, --input_file too; what they show on the screen is left out). Other than there, the sensor's size has no
    default, and frames lie in an EuRoC folder.
    """
    import json
    import logging

    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.recording import EventFile

    if (source is None) == (named_source is None):
        raise click.UsageError("Name one event recording: EVENTS, or --h5file.")
    if options["verbose"]:
        logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = _folder(options)
    with ProgressBars() as bars, EventFile(source or named_source or "", *_size(options)) as events:
        summary = _reconstruct(events, folder, options, bars)
    if options["as_json"]:
        click.echo(json.dumps(summary, indent=2))
        return
    state = "complete already" if summary["reused"] else f"{summary['seconds']:.1f} s"
    click.echo(f"{folder}: {summary['frames']:,} frames of {summary['width']}x{summary['height']} ({state})")
    if summary["bag"]:
        click.echo(f"{summary['bag']}: written, topic {options['topic']}")


def _reconstruct(events: "EventFile", folder: Path, options: dict[str, Any], bars: Any) -> dict[str, Any]:
    import json
    import time

    import reconstruction
    from jaxcal.event_frames import frames_key, write_event_frames
    from jaxcal.recording.frame_writers import write_frame_bag
    from reconstruction.reconstructor import find_device, reduced_precision

    start = time.perf_counter()
    network = reconstruction.load_network(options["path_to_model"])
    settings = _reconstructor_options(options)
    # Mistakes in the options are reported before anything is read.
    device = find_device(settings.get("device"))
    dtype = reduced_precision(network, device, settings["precision"])
    plan = _plan(events, options)
    facts = {"key": frames_key(events, plan, network, settings), "events": str(events.path)}
    count = _made_already(folder, facts["key"])
    reused = count is not None
    if count is None:
        note = {_NOTE: json.dumps(facts, indent=1) + "\n"}
        count = write_event_frames(
            folder,
            events,
            plan,
            network,
            settings,
            notes=note,
            replace=options["overwrite"],
            stage=f"reconstruct {events.path.name}",
            progress=bars,
        )
    if options["bag"] is not None:
        write_frame_bag(options["bag"], folder, options["topic"], progress=bars)
    return {
        "frames": count,
        "reused": reused,
        "width": events.width,
        "height": events.height,
        "output": str(folder),
        "bag": None if options["bag"] is None else str(options["bag"]),
        "network": type(network).__name__,
        "device": str(device),
        "precision": "float32" if dtype is None else str(dtype).removeprefix("torch."),
        "seconds": round(time.perf_counter() - start, 3),
    }


def _folder(options: dict[str, Any]) -> Path:
    if options["output"] is not None and options["output_folder"] is not None:
        raise click.UsageError("Give --output or e2calib's --output_folder, not both.")
    if options["output"] is not None:
        return options["output"]
    return (options["output_folder"] or Path("frames")) / options["dataset_name"]


def _size(options: dict[str, Any]) -> tuple[int | None, int | None]:
    if (options["width"] is None) != (options["height"] is None):
        raise click.UsageError("Give both --width and --height, or none of them.")
    return options["width"], options["height"]


def _made_already(folder: Path, key: str) -> int | None:
    """The number of frames, where the folder holds those that are wanted."""
    import json

    from jaxcal.recording.images import listed_images

    try:
        found = json.loads((folder / _NOTE).read_text())
    except (OSError, ValueError):
        return None
    if not isinstance(found, dict) or found.get("key") != key:
        return None
    return len(listed_images(folder / "data.csv")[0])


def _plan(events: "EventFile", options: dict[str, Any]) -> "WindowPlan":
    from jaxcal.recording import load_frames
    from jaxcal.recording.windows import periodic

    times = _times(events, options)
    if options["freq_hz"] > 0:  # as e2calib: from the first event on, in whole microseconds
        period_ns = max(int(1e6 / options["freq_hz"]), 1) * 1000
        return periodic(events, period_ns, origin_ns=events.first_ns, upsample_rate=times.upsample_rate)
    if times.window_ms is not None and options["window_duration"] is not None:  # as E2VID
        period_ns = round(times.window_ms * 1e6)
        return periodic(events, period_ns, origin_ns=events.first_ns, upsample_rate=times.upsample_rate)
    stamps = None if times.stamps_of is None else load_frames(times.stamps_of).timestamps_ns
    return times.plan(events, stamps)


def _times(events: "EventFile", options: dict[str, Any]) -> "FrameTimes":
    from jaxcal.recording import FrameTimes

    number, per_pixel, duration = (options[name] for name in ("window_size", "num_events_per_pixel", "window_duration"))
    if number is None and per_pixel is not None:
        number = max(1, int(events.width * events.height * per_pixel))
    if options["fixed_duration"]:  # then E2VID ignores a number of events, and has this default
        number, duration = None, duration or 33.33
        options["window_duration"] = duration
    times = FrameTimes(
        window_ms=duration,
        rate_hz=None if options["imu"] is None else _rate_for_spline(options["imu"]),
        timestamps=options["timestamps_file"],
        triggers=options["triggers"],
        stamps_of=options["stamps_of"],
        events_per_window=number,
        trigger_channel=options["trigger_channel"],
        time_offset_ms=1e-3 * options["time_offset_us"],
        upsample_rate=options["upsample_rate"],
    )
    ways = ["imu" if name == "rate_hz" else name for name in times.chosen()]
    ways = [*ways, *(["freq_hz"] if options["freq_hz"] > 0 else [])]
    if len(ways) > 1:
        raise click.UsageError(f"{' and '.join(ways)} each say when frames are wanted; give only one.")
    return times if ways else times.or_windows_of(_WINDOW_MS)


def _rate_for_spline(data: str) -> float:
    from jaxcal.calibration import frame_rate_for_spline
    from jaxcal.observations import ImuNoise
    from jaxcal.recording import load_imu

    return frame_rate_for_spline(load_imu(ImuNoise(1.0, 1.0, 1.0, 1.0), data))  # its noise has no say here


def _reconstructor_options(options: dict[str, Any]) -> dict[str, Any]:
    if options["use_gpu"] and options["device"] is not None:
        raise click.UsageError("Give --device or e2calib's --use_gpu, not both.")
    if options["hot_pixels"] is not None and options["hot_pixels_file"] is not None:
        raise click.UsageError("Give --hot_pixels auto or a --hot_pixels_file, not both.")
    names = (
        "unsharp_mask_amount",
        "unsharp_mask_sigma",
        "bilateral_filter_sigma",
        "flip",
        "Imin",
        "Imax",
        "auto_hdr",
        "auto_hdr_median_filter_size",
        "no_normalize",
        "no_recurrent",
    )
    hot_pixels = options["hot_pixels"] or (
        None if options["hot_pixels_file"] is None else str(options["hot_pixels_file"])
    )
    return {
        **{name: options[name] for name in names},
        "precision": "float16" if options["use_fp16"] else options["precision"],
        "device": f"cuda:{options['gpu_id']}" if options["use_gpu"] else options["device"],
        "bayer": options["bayer"] or ("rggb" if options["color"] else None),
        "hot_pixels": hot_pixels,
    }
