"""`FILE:PLACE`: a file, and a topic or group inside it."""

import os
from pathlib import Path


def split_place(path: str | Path) -> tuple[Path, str | None]:
    """The file, and the topic or group inside it that is named behind a colon, or None.

    `drive.bag:/cam0/image_raw` is the topic `/cam0/image_raw` of `drive.bag`. A file that exists under the whole name
    is taken as it is, so that colons in names do no harm.
    """
    text = os.fspath(path)
    if not os.path.exists(text):
        head, colon, tail = text.rpartition(":")
        if colon and tail and os.path.exists(head):
            return Path(head), tail
        head, colon, tail = text.rpartition(":/")  # a file that is missing is named without its topic
        if colon and head and not head.endswith(("/", "\\")) and len(head) > 1:
            return Path(head), "/" + tail
    return Path(text), None
