"""The curve of a training: metrics.jsonl, one JSON object per line, and TensorBoard's events if asked for.

A line is {"step": 500, "kind": "train", name: value, ...}; a value that is not finite is null. After a kill the last
line may be half written and lines may lie beyond the checkpoint that the training goes on from: both are cut off, so
that no step stands twice.
"""

import json
import math
import os
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import jax

from jprimfit.training import events

NAME = "metrics.jsonl"


class Writer:
    """Appends to the metrics of a workdir; use it in a with statement. Processes other than the first write nothing.

    resumed_step is the step of the checkpoint that the training goes on from: lines up to it stay. None begins anew.
    With tensorboard the same values go to folder/tensorboard, one file per start, each kind a folder of tags.
    """

    def __init__(
        self, folder: str | os.PathLike[str], tensorboard: bool = False, *, resumed_step: int | None = None
    ) -> None:
        self.path = Path(folder) / NAME
        self._file: IO[str] | None = None
        self._events: IO[bytes] | None = None
        if jax.process_index() != 0:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        kept = [] if resumed_step is None else [line for line in read(folder) if line["step"] <= resumed_step]
        partial = self.path.with_name(f".{NAME}.{uuid.uuid4().hex}.partial")
        partial.write_text("".join(_line(line) for line in kept), encoding="utf-8", newline="\n")
        os.replace(partial, self.path)
        self._file = open(self.path, "a", encoding="utf-8", newline="\n")
        if tensorboard:
            place = self.path.parent / "tensorboard"
            place.mkdir(exist_ok=True)
            now = time.time()
            self._events = open(place / f"events.out.tfevents.{int(now)}.{uuid.uuid4().hex[:8]}", "xb")
            self._events.write(events.first_event(seconds=now))

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, step: int, kind: str, scalars: Mapping[str, Any]) -> None:
        """Adds the values, numbers or arrays of shape (), of one step; kind is "train", "validation", ..."""
        if self._file is None:
            return
        values = {name: float(value) for name, value in scalars.items()}
        finite = {name: value if math.isfinite(value) else None for name, value in values.items()}
        self._file.write(_line({"step": step, "kind": kind, **finite}))
        self._file.flush()  # a kill loses nothing; only a crash of the whole machine may
        if self._events is not None:
            tags = {f"{kind}/{name}": value for name, value in values.items()}
            self._events.write(events.scalars_event(step, tags, seconds=time.time()))
            self._events.flush()

    def close(self) -> None:
        """Closes the files."""
        for file in (self._file, self._events):
            if file is not None:
                file.close()


def read(folder: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The lines of a workdir's metrics.jsonl in order, without what is no whole line; empty where there is no file."""
    path = Path(folder) / NAME
    if not path.exists():
        return []
    lines = []
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except ValueError:
            continue
        if isinstance(line, dict) and isinstance(line.get("step"), int):
            lines.append(line)
    return lines


def _line(values: Mapping[str, Any]) -> str:
    return json.dumps(values, allow_nan=False) + "\n"
