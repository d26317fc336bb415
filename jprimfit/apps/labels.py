"""Segments that the user corrected: the labels of an earlier answer or another program, merged and retyped by words."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

FORMATS = "scene.json or segments.ply of an earlier answer, NPY, or text with one integer per line"


def read_labels(path: Path) -> np.ndarray:
    """The segment of each point, in the order of the scan's points; ValueError of one sentence if there is none."""
    if not path.is_file():
        raise ValueError(f"--labels {path} does not exist: give {FORMATS}.")
    if path.suffix.lower() == ".json":
        from jprimfit.scene import Scene

        return Scene.load(path).labels
    if path.suffix.lower() == ".ply":
        from jprimfit.io import ply

        return ply.read_labels(path)
    try:
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False)
        return np.loadtxt(path, dtype=np.int64, comments="#", ndmin=1)
    except (ValueError, OSError, EOFError) as error:
        reason = " ".join(str(error).split()).rstrip(".")[:120]
        raise ValueError(f"--labels {path} cannot be read ({reason}): give {FORMATS}.") from None


def merged(labels: np.ndarray, merges: Sequence[str]) -> np.ndarray:
    """The labels after every one of the words "3,7,9": segments 7 and 9 become part of 3."""
    labels = np.array(labels)
    for words in merges:
        try:
            first, *others = (int(word) for word in words.split(","))
        except ValueError:
            raise ValueError(f"--merge {words} is no list of labels: write --merge 3,7.") from None
        if not others:
            raise ValueError(f"--merge {words} names one segment: write two or more, such as --merge 3,7.")
        for label in (first, *others):
            if label < 0 or not np.any(labels == label):
                raise ValueError(f"--merge {words}: no point has the label {label}.")
        labels[np.isin(labels, others)] = first
    return labels


def retyped(words: Sequence[str]) -> dict[int, str]:
    """The kind of each label in words such as "5=cone"."""
    kind_of = {}
    for word in words:
        label, _, kind = word.partition("=")
        if not label.strip().isdecimal() or not kind:
            raise ValueError(f"--retype {word} is no label and kind: write --retype 5=cone.")
        kind_of[int(label)] = kind.strip()
    return kind_of
