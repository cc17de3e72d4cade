"""How fast event files are read, on one core: every format, whole and in windows, beside other readers where installed.

    python experiments/bench_event_files.py --events 20000000
    pip install faery expelliarmus      # to compare with

A synthetic recording (events along moving edges, as a sensor that reads out rows gives them) is written in each format
and read back: whole, in chunks; in windows of 10 ms, as the reconstruction reads it; and 200 windows at random. The
file is in the system's cache, so that the reader is measured and not the disk. The best of three passes counts.
"""

import argparse
import importlib.util
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxcal.recording import EventFile, write_events
from jaxcal.recording.formats.contract import EventColumns

WIDTH, HEIGHT = 1280, 720
ROWS_PER_STEP, EVENTS_PER_ROW = 4, 6  # of what fires at a time
WINDOW_NS = 10_000_000


@dataclass(frozen=True)
class Speed:
    """Size of the file; events per second, read whole and in windows; milliseconds for a window at random."""

    name: str
    megabytes: float
    whole: float
    windows: float
    random_ms: float


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=20_000_000, help="events in the recording")
    parser.add_argument("--text-events", type=int, default=2_000_000, help="events in text and AEDAT4 files")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="jaxcal-bench-") as name:
        folder = Path(name)
        print(f"{'format':<22} {'MB':>8} {'whole':>10} {'windows':>10} {'random':>9}")
        print(f"{'':<22} {'':>8} {'Mevents/s':>10} {'Mevents/s':>10} {'ms each':>9}")
        for label, path in written(folder, arguments.events, arguments.text_events):
            print_speed(measured(label, path))
            if path.suffix == ".raw":
                for other, read in other_readers(label):
                    seconds = best_of(3, lambda read=read, path=path: read(path))
                    print(f"  {other:<20} {'':>8} {arguments.events / seconds / 1e6:>10.1f}")
            path.unlink()
    return 0


def print_speed(speed: Speed) -> None:
    """A row of the table."""
    print(
        f"{speed.name:<22} {speed.megabytes:>8.1f} {speed.whole / 1e6:>10.1f} {speed.windows / 1e6:>10.1f} "
        f"{speed.random_ms:>9.2f}",
        flush=True,
    )


def measured(label: str, path: Path) -> Speed:
    """Events per second read as a whole and in windows, and the time for a window anywhere."""
    with EventFile(path, WIDTH, HEIGHT) as file:  # compiles the decoder and finds the span
        count, (first, last) = len(file), file.span()
    whole = best_of(3, lambda: sum(map(len, opened(path).chunks())))
    windows = best_of(3, lambda: sum(len(part) for _, part in opened(path).windows(WINDOW_NS, first)))
    starts = np.random.default_rng(0).integers(first, max(first + 1, last - WINDOW_NS), 200)
    with EventFile(path, WIDTH, HEIGHT) as file:
        assert len(file) == count
        begin = time.perf_counter()
        for start in starts:
            file.window(int(start), int(start) + WINDOW_NS)
        random_ms = (time.perf_counter() - begin) / len(starts) * 1e3
    return Speed(label, path.stat().st_size / 1e6, count / whole, count / windows, random_ms)


def opened(path: Path) -> EventFile:
    """The file, opened for the sensor of this benchmark."""
    return EventFile(path, WIDTH, HEIGHT)


def best_of(passes: int, work: Callable[[], object]) -> float:
    """Seconds of the fastest pass."""
    seconds = []
    for _ in range(passes):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def other_readers(label: str) -> Iterator[tuple[str, Callable[[Path], object]]]:
    """Readers of RAW files that are installed, each reading a whole file in chunks."""
    encoding = label.split()[-1].lower()
    if importlib.util.find_spec("faery") and encoding != "evt21":
        import faery  # pyright: ignore[reportMissingImports]

        yield "faery", lambda path: sum(len(part) for part in faery.events_stream_from_file(path, (WIDTH, HEIGHT)))
    if importlib.util.find_spec("expelliarmus") and encoding != "evt21":
        import expelliarmus  # pyright: ignore[reportMissingImports]

        yield "expelliarmus", lambda path: len(expelliarmus.Wizard(encoding).read(path))


# --- synthetic recordings --------------------------------------------------------------------------------------------


def bursts(count: int, seed: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Runs of `EVENTS_PER_ROW` neighbouring columns, `ROWS_PER_STEP` rows a microsecond-step: t, row, column, polarity
    of each run; together `count` events, in pieces."""
    rng = np.random.default_rng(seed)
    runs, step = count // EVENTS_PER_ROW, 250_000
    t = 0
    for start in range(0, runs, step):
        n = min(step, runs - start)
        times = t + np.cumsum(rng.integers(0, 3, n) * (np.arange(n) % ROWS_PER_STEP == 0))
        t = int(times[-1])
        yield times, rng.integers(0, HEIGHT, n), rng.integers(0, WIDTH - 40, n), rng.integers(0, 2, n)


def columns(count: int) -> Iterator[EventColumns]:
    """`count` events or so, in chunks."""
    start = 0
    for t, row, column, polarity in bursts(count):
        n = EVENTS_PER_ROW
        x = (column[:, None] + 2 * np.arange(n)).ravel()
        yield EventColumns(
            start, np.repeat(t, n) * 1000, x.astype(np.uint16), np.repeat(row, n).astype(np.uint16),
            np.repeat(polarity, n).astype(bool),
        )  # fmt: skip
        start += len(x)


def written(folder: Path, count: int, text_count: int) -> Iterator[tuple[str, Path]]:
    """One file after the other, with a label; each may be deleted before the next is asked for."""
    yield "RAW EVT3", write_raw(folder / "evt3.raw", "3.0", evt3_words(count))
    yield "RAW EVT2", write_raw(folder / "evt2.raw", "2.0", evt2_words(count))
    yield "RAW EVT21", write_raw(folder / "evt21.raw", "2.1", evt21_words(count))
    for suffix, events in ((".h5", count), (".npz", count), (".txt", text_count)):
        path = folder / f"events{suffix}"
        write_events(path, columns(events), (WIDTH, HEIGHT))
        yield suffix[1:], path


def write_raw(path: Path, version: str, words: Iterator[np.ndarray]) -> Path:
    """A RAW file of `words` with Prophesee's header; returns `path`."""
    with path.open("wb") as file:
        file.write(f"% evt {version}\n% geometry {WIDTH}x{HEIGHT}\n% end\n".encode())
        for part in words:
            part.tofile(file)
    return path


def evt3_words(count: int) -> Iterator[np.ndarray]:
    """TIME_HIGH, TIME_LOW, ADDR_Y, VECT_BASE_X, VECT_12 for each run: the words that a sensor sends most."""
    valid = sum(1 << 2 * k for k in range(EVENTS_PER_ROW))
    for t, row, column, polarity in bursts(count):
        high, low = 0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF
        words = np.stack([high, low, row, 0x3000 | polarity << 11 | column, np.full(len(t), 0x4000 | valid)], axis=1)
        new_high, new_low = (np.diff(values, prepend=-1) != 0 for values in (high, low))
        keep = np.stack([new_high, new_low | new_high, *[np.ones(len(t), bool)] * 3], axis=1)
        yield words[keep].astype("<u2")


def evt2_words(count: int) -> Iterator[np.ndarray]:
    """The events as EVT2."""
    for piece in columns(count):
        t, x, y, p = (values.astype(np.int64) for values in (piece.t_ns // 1000, piece.x, piece.y, piece.p))
        words = np.stack([0x8 << 28 | t >> 6, p << 28 | (t & 0x3F) << 22 | x << 11 | y], axis=1)
        keep = np.stack([np.diff(t >> 6, prepend=-1) != 0, np.ones(len(t), bool)], axis=1)
        yield words[keep].astype("<u4")


def evt21_words(count: int) -> Iterator[np.ndarray]:
    """The events as EVT2.1."""
    valid = sum(1 << 2 * k for k in range(EVENTS_PER_ROW))
    for t, row, column, polarity in bursts(count):
        upper = np.stack([0x8 << 28 | t >> 6, polarity << 28 | (t & 0x3F) << 22 | column << 11 | row], axis=1)
        lower = np.stack([np.zeros(len(t), np.int64), np.full(len(t), valid)], axis=1)
        keep = np.stack([np.diff(t >> 6, prepend=-1) != 0, np.ones(len(t), bool)], axis=1)
        yield np.stack([lower[keep], upper[keep]], axis=1).astype("<u4")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
