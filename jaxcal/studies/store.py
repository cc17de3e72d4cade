"""The rows of a study on disk: appended as they come, each complete or ignored, so that a study resumes."""

import json
import os
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from jaxcal.atomic import write_text
from jaxcal.errors import CalibrationError

ROWS_FILE = "rows.jsonl"
STUDY_FILE = "study.json"


class RowStore:
    """Rows (JSON objects with an integer `index`) of one study in a folder.

    A line of `rows.jsonl` is a checksum, a blank and the row. What a kill left half written does not match its
    checksum and is ignored; of two rows of one index the first counts. `identity` says which study it is, in
    `study.json`. Only one process at a time may append: a study runs its tasks elsewhere and stores them in one place.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        """Open the folder's study, or begin one. Raises CalibrationError when the folder holds another study."""
        self.folder, self.path = folder, folder / ROWS_FILE
        folder.mkdir(parents=True, exist_ok=True)
        _check_identity(folder / STUDY_FILE, self.path, json.loads(json.dumps(identity)))
        self.rows: dict[int, dict[str, Any]] = _read(self.path)

    def append(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Store rows on the disk; those of an index that is there already are left out."""
        new = {int(row["index"]): dict(row) for row in rows if int(row["index"]) not in self.rows}
        if not new:
            return
        text = "".join(_line(row) for row in new.values())
        with self.path.open("a+b") as file:
            file.seek(0, os.SEEK_END)
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # a line that a kill cut off
                    text = "\n" + text
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        self.rows |= {index: json.loads(json.dumps(row)) for index, row in new.items()}


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """All complete rows of a study's folder, in order of their index."""
    rows = _read(folder / ROWS_FILE)
    return [rows[index] for index in sorted(rows)]


def _line(row: Mapping[str, Any]) -> str:
    text = json.dumps(row, separators=(",", ":"))
    return f"{zlib.crc32(text.encode()):08x} {text}\n"


def _read(path: Path) -> dict[int, dict[str, Any]]:
    rows: dict[int, dict[str, Any]] = {}
    if not path.exists():
        return rows
    for line in path.read_bytes().split(b"\n"):
        checksum, _, text = line.partition(b" ")
        if text and checksum == f"{zlib.crc32(text):08x}".encode():
            row = json.loads(text)
            rows.setdefault(int(row["index"]), row)
    return rows


def _check_identity(path: Path, rows: Path, identity: Mapping[str, Any]) -> None:
    if not path.exists():
        if rows.exists():
            raise CalibrationError(f"{rows}: rows of a study without its {STUDY_FILE}. Choose another folder.")
        write_text(path, json.dumps(identity, indent=2) + "\n")
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{path}: not readable ({error}). Choose another folder.") from error
    differing = sorted(key for key in {*before, *identity} if before.get(key) != identity.get(key))
    if differing:
        key = differing[0]
        raise CalibrationError(
            f"{path.parent}: holds another study; it differs in {', '.join(differing)} ({key}: "
            f"{_short(before.get(key))} there, {_short(identity.get(key))} here). Choose another folder, or delete it."
        )


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
