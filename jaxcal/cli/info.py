"""`jaxcal info`: what a recording holds, and whether it is in order."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.sizes import Size

if TYPE_CHECKING:
    from jaxcal.recording.bags import Topic
    from jaxcal.recording.event_facts import EventFacts

_HOT_PIXELS_LISTED = 5
_GAPS_LISTED = 3


@click.command()
@click.argument("file")
@click.option("--resolution", type=Size(), help="Size of the sensor, where the file does not tell it.")
@click.option("--gap", default=50.0, show_default=True, help="How long nothing must happen to be a gap; ms.")
@click.option("--json", "as_json", is_flag=True, help="Everything as one JSON object, all hot pixels included.")
def info(file: str, resolution: tuple[int, int] | None, gap: float, as_json: bool) -> None:
    """Say what an event recording or a bag holds.

    \b
    jaxcal info recording.raw
    jaxcal info events.h5 --resolution 640x480
    jaxcal info stereo.h5:/prophesee/left
    jaxcal info drive.bag                       lists the topics, too
    jaxcal info drive.bag:/dvs/events --json

    \b
    Event formats, told apart by content:
        Prophesee RAW (EVT2, EVT2.1, EVT3) and DAT      HDF5 of e2calib, DSEC, M3ED, Prophesee
        bags of ROS 1, ROS 2 and mcap                   AEDAT4, npz, text (t x y p)

    The whole recording is read once. Time that runs backwards and events off the sensor are counted here, and are
    errors elsewhere: `jaxcal convert events IN OUT.h5 --sort 100` mends the first. A hot pixel fires more than ten
    times as often as its neighbours.
    """
    import json

    from jaxcal.cli.progress_bars import ProgressBars
    from jaxcal.errors import CalibrationError
    from jaxcal.recording import EventFile, event_facts
    from jaxcal.recording.bags import Bag, is_bag
    from jaxcal.recording.formats.rosbag import EVENT_TYPES
    from jaxcal.recording.places import split_place

    path, place = split_place(file)
    if path.is_dir() and not is_bag(path):
        raise CalibrationError(
            f"{path}: a folder; expected an event recording or a bag. `jaxcal init {path}` says what images, events "
            "and IMU data a folder holds."
        )
    topics: list[Topic] = []
    if path.exists() and is_bag(path):
        with Bag(path) as bag:
            topics = bag.topics()
    facts = None
    event_topics = [topic for topic in topics if topic.kind in EVENT_TYPES and topic.count]
    if place is not None or not topics or len(event_topics) == 1:
        with ProgressBars() as bars, EventFile(file, *(resolution or (None, None))) as events:
            facts = event_facts(events, gap * 1e-3, bars)
    if as_json:
        click.echo(json.dumps(_as_json(topics, facts), indent=2))
        return
    if topics:
        click.echo(f"{path}: topics and numbers of messages")
        width = max(len(topic.name) for topic in topics)
        for topic in topics:
            click.echo(f"  {topic.name:<{width}}  {topic.count:>9,}  {topic.kind}")
    if facts is not None:
        click.echo("\n".join(_lines(facts)))
    elif len(event_topics) > 1:
        click.echo(f"Name one for more: {' or '.join(f'{path}:{topic.name}' for topic in event_topics)}")


def _as_json(topics: "list[Topic]", facts: "EventFacts | None") -> dict[str, Any]:
    content: dict[str, Any] = {"topics": [asdict(topic) for topic in topics]} if topics else {}
    if facts is not None:
        content["events"] = asdict(facts) | {
            "path": str(facts.path),
            "triggers": {
                str(channel): {"rising": rising, "falling": falling}
                for channel, (rising, falling) in facts.triggers.items()
            },
        }
    return content


def _lines(facts: "EventFacts") -> list[str]:
    width, height = facts.sensor or (facts.reach[0] + 1, facts.reach[1] + 1)
    sensor = f"{width}x{height}" if facts.sensor else f"sensor not told, events reach {width}x{height}"
    lines = [
        f"{facts.path}: {facts.format}, {sensor}, {_bytes(facts.file_bytes)}",
        f"  events     {facts.count:,} in {facts.span_s:.3f} s; {100 * facts.on_share:.1f} % ON",
        f"  rate       {_rate(facts.mean_rate)} on average, {_rate(facts.peak_rate)} at most over 10 ms",
        f"  time       {_time(facts.first_ns)} to {_time(facts.last_ns)} s",
        f"  gaps       {_gaps(facts)}",
        f"  hot pixels {_hot_pixels(facts)}",
    ]
    for channel, (rising, falling) in facts.triggers.items():
        lines.append(f"  triggers   channel {channel}: {rising:,} rising, {falling:,} falling")
    return lines + [f"  note       {text}" for text in _notes(facts)]


def _gaps(facts: "EventFacts") -> str:
    if not facts.gap_count:
        return "none"
    listed = [f"{gap.length_s * 1e3:.0f} ms at {gap.start_s:.3f} s" for gap in facts.gaps[:_GAPS_LISTED]]
    more = f", and {facts.gap_count - len(listed)} more" if facts.gap_count > len(listed) else ""
    return f"{', '.join(listed)}{more}"


def _hot_pixels(facts: "EventFacts") -> str:
    if not facts.hot_pixels:
        return "none"
    share = 100 * sum(pixel.count for pixel in facts.hot_pixels) / facts.count
    listed = ", ".join(f"({pixel.x}, {pixel.y}) {pixel.count:,}" for pixel in facts.hot_pixels[:_HOT_PIXELS_LISTED])
    more = ", ..." if len(facts.hot_pixels) > _HOT_PIXELS_LISTED else ""
    return f"{len(facts.hot_pixels)}, {share:.1f} % of the events: {listed}{more}"


def _notes(facts: "EventFacts") -> list[str]:
    notes = list(facts.remarks)
    if facts.backwards:
        notes.append(
            f"time runs backwards {facts.backwards:,} times, by {facts.largest_backwards_s * 1e3:.3f} ms at most: "
            "`jaxcal convert events IN OUT.h5 --sort MS` sorts"
        )
    if facts.outside:
        notes.append(f"{facts.outside:,} events lie off the sensor: is the resolution right?")
    if facts.repeated:
        notes.append(f"{facts.repeated:,} events have the time and pixel of the one before")
    return notes


def _rate(rate: float) -> str:
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if rate >= size:
            return f"{rate / size:.3g} {unit}events/s"
    return f"{rate:.3g} events/s"


def _bytes(size: int) -> str:
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= factor:
            return f"{size / factor:.3g} {unit}"
    return f"{size} bytes"


def _time(t_ns: int) -> str:
    sign, size = ("-", -t_ns) if t_ns < 0 else ("", t_ns)
    return f"{sign}{size // 1_000_000_000}.{size % 1_000_000_000 // 1000:06d}"
