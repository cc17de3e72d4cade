"""Files of other tools as plain Python values: yaml, OpenCV's yaml and xml, json and text."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jaxcal.errors import CalibrationError

SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".txt")


@dataclass(frozen=True)
class Document:
    """A file that was read: `content` is a mapping, a list or a scalar, or the text of a .txt file.

    `by_opencv` tells files for OpenCV's FileStorage, by their first line or as xml.
    """

    path: Path
    content: Any
    by_opencv: bool = False

    def has(self, *keys: str) -> bool:
        """Whether the content is a mapping with all these keys."""
        return isinstance(self.content, Mapping) and all(key in self.content for key in keys)

    def __getitem__(self, key: str) -> Any:
        """The value of a key. Raises CalibrationError where there is none."""
        return value_of(self.content, key, str(self.path))


def value_of(content: Any, key: str, where: str) -> Any:
    """`content[key]`. Raises CalibrationError, with the keys that are there, where it is missing."""
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{where}: expected keys with values; found {content!r}.")
    if key not in content:
        raise CalibrationError(f"{where}: '{key}' is missing. It has: {', '.join(str(name) for name in content)}.")
    return content[key]


def read_document(path: Path) -> Document:
    """Read a file by its suffix. Raises CalibrationError when it is missing or not what its suffix says."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such file.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a text file that can be read: {error}") from error
    if path.suffix == ".txt":
        return Document(path, text)
    try:
        if path.suffix == ".json":
            return Document(path, json.loads(text))
        if path.suffix == ".xml":
            return Document(path, _xml(text), by_opencv=True)
        return Document(path, _yaml(text), by_opencv=text.startswith("%YAML"))
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise CalibrationError(f"{path}: not a {path.suffix.lstrip('.')} file that can be read: {error}") from error


class _Loader(yaml.SafeLoader):
    """Yaml with OpenCV's matrices."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> np.ndarray:
    if not isinstance(node, yaml.MappingNode):
        raise ValueError("a matrix without rows, cols and data")
    fields = loader.construct_mapping(node, deep=True)
    # Yaml 1.1 takes '1e-5' for text.
    data = np.array([float(value) for value in fields["data"]])
    return data.reshape(int(fields["rows"]), int(fields["cols"]))


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _yaml(text: str) -> Any:
    """Yaml, also with the first line `%YAML:1.0` that OpenCV writes and yaml does not know."""
    if text.startswith("%YAML"):
        text = text.partition("\n")[2]
    try:
        return yaml.load(text, Loader=_Loader)
    except (KeyError, TypeError) as error:
        raise ValueError(f"a matrix that is not complete ({error})") from error


def _xml(text: str) -> Any:
    import cv2

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        return _node(storage.root())
    except (cv2.error, SystemError) as error:
        raise ValueError("OpenCV's FileStorage cannot read it") from error


def _node(node: Any) -> Any:
    """A node of a FileStorage as a mapping, list, matrix, number or text."""
    if node.isMap():
        keys = node.keys()
        if {"rows", "cols", "data"} <= set(keys):
            return node.mat()
        return {key: _node(node.getNode(key)) for key in keys}
    if node.isSeq():
        return [_node(node.at(k)) for k in range(node.size())]
    if node.isInt():
        return int(node.real())
    return node.real() if node.isReal() else node.string()
