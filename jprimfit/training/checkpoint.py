"""Checkpoints of a training: written while it goes on, checked when read, the newest readable one taken. All of Orbax.

A checkpoint `folder/<step>` has two items: `state`, the leaves of the training state under dotted names, and `record`,
a JSON with the step, metrics, config and shape, type and CRC-32 of every leaf: Orbax itself notices no flipped bit.
Leaves are stored as plain arrays without placement, so that any number of devices can read what any other wrote.
"""

import json
import math
import os
import sys
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

FORMAT = "jprimfit-checkpoint"
VERSION = 1
SCORE = "miou"  # the metric by which a checkpoint is the best
STRAGGLERS = 0.2  # seconds in which reads beside a failed one end
MAX_REASON = 200  # letters of a library's message that are repeated in ours


class CheckpointError(ValueError):
    """A checkpoint that cannot be written or read; its message is the sentence for the user."""


class ForeignCheckpoint(CheckpointError):
    """A sound checkpoint of another network; no older one is tried."""


class Checkpoints:
    """The checkpoints in a folder: the latest few and the best one by validation mIoU; use it in a with statement.

    config is any JSON mapping, stored with every checkpoint. With read_only nothing in the folder is touched, which is
    what an evaluation needs while a training still writes. Every process of a training calls every method. All faults
    are CheckpointErrors, ValueErrors of one sentence.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        keep_latest: int = 2,
        *,
        config: Mapping[str, Any] | None = None,
        read_only: bool = False,
    ):
        self.folder = Path(folder).resolve()
        self.config = dict(config or {})
        self._keep_latest = keep_latest
        self._scores: dict[int, float] | None = None  # of the checkpoints on disk, read when first needed
        self._damaged: list[int] = []  # found by restore, put aside by the next save
        if (read_only or self.folder.exists()) and not self.folder.is_dir():
            raise CheckpointError(f"{folder} is no folder of checkpoints: give the workdir of a training.")
        options = ocp.CheckpointManagerOptions(
            preservation_policy=self,
            cleanup_tmp_directories=not read_only,  # what a killed save left
            lightweight_initialize=True,  # else one damaged file of metrics closes the whole folder
            read_only=read_only,
        )
        handlers = {"state": ocp.PyTreeCheckpointHandler(), "record": ocp.JsonCheckpointHandler()}
        with _sentences(f"{folder} cannot be used for checkpoints"):
            self._manager = ocp.CheckpointManager(self.folder, options=options, item_handlers=handlers)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def steps(self) -> tuple[int, ...]:
        """The steps of which there is a checkpoint, damaged ones included, increasing."""
        return tuple(sorted(self._manager.all_steps()))

    def save(self, step: int, state: Any, metrics: Mapping[str, float] | None = None) -> None:
        """Starts to write a checkpoint and returns; the state may be donated at once.

        Leaves are numbers or numeric arrays, each whole or replicated on this process. metrics["miou"] makes it a
        candidate for the best. Does nothing where that step is stored. A previous save that failed raises here.
        """
        if self._damaged:
            self._put_aside()
        if step in self.steps():
            return
        if self.steps() and step < self.steps()[-1]:
            raise CheckpointError(
                f"{self.folder} holds a checkpoint of step {self.steps()[-1]}, so none of the earlier step {step} is "
                "added: resume from it, or give a new folder."
            )
        leaves = {name: _copied(name, leaf) for name, leaf in _named(state).items()}
        record = _record(step, leaves, metrics or {}, self.config)
        scores = self._known_scores()
        if SCORE in record["metrics"]:
            scores[step] = record["metrics"][SCORE]
        stored = {name: value for name, value in leaves.items() if value.size}  # Orbax refuses empty arrays
        items = ocp.args.Composite(
            state=ocp.args.PyTreeSave(stored),  # pyright: ignore[reportCallIssue]
            record=ocp.args.JsonSave(record),  # pyright: ignore[reportCallIssue]
        )
        with _sentences(f"{self.folder / str(step)} cannot be written"):
            if not self._manager.save(step, args=items):
                raise OSError("Orbax declined to save it")

    def restore(self, template: Any) -> tuple[int, Any] | None:
        """Step and state of the newest checkpoint that can be read, placed like the template; None if there is none.

        The template is a state, or ShapeDtypeStructs with or without sharding. Damaged checkpoints are named on stderr
        and passed over; the next save puts them aside as `damaged-<step>`. ForeignCheckpoint if the newest sound one
        has other leaves than the template, CheckpointError if there are checkpoints and all are damaged.
        """
        return self._first_readable(sorted(self.steps(), reverse=True), template)

    def restore_best(self, template: Any) -> tuple[int, Any] | None:
        """As restore, but the checkpoint with the highest validation mIoU; None if no stored one has been validated."""
        scores = self._known_scores()
        return self._first_readable(sorted(scores, key=lambda step: (scores[step], step), reverse=True), template)

    def record(self, step: int) -> dict[str, Any]:
        """What is written of a checkpoint beside its leaves: step, metrics, config and the list of leaves."""
        place = self.folder / str(step)
        with _sentences(f"{place} is damaged"):
            restored = self._manager.restore(step, args=ocp.args.Composite(record=ocp.args.JsonRestore()))
            record = restored["record"]
            if not isinstance(record, dict) or record.get("format") != FORMAT:
                raise ValueError("its record is not that of a jprimfit checkpoint")
            if record.get("version") != VERSION:
                raise ValueError(f"its version is {record.get('version')!r} and this jprimfit reads {VERSION}")
            if record.get("crc32") != _crc_of_json(record):
                raise ValueError("its record has changed since it was written")
        return record

    def wait(self) -> None:
        """Returns when what was saved is on disk."""
        with _sentences(f"{self.folder} lacks the last checkpoint, which cannot be written"):
            self._manager.wait_until_finished()
            self._manager.check_for_errors()

    def close(self) -> None:
        """Waits and ends the threads."""
        with _sentences(f"{self.folder} lacks the last checkpoint, which cannot be written"):
            self._manager.close()

    def should_preserve(self, checkpoints: Any, *, context: Any) -> list[bool]:
        """Which checkpoints, in order of their steps, are kept after a save: what Orbax calls a preservation policy."""
        steps, scores = [checkpoint.step for checkpoint in checkpoints], self._known_scores()
        best = max((step for step in steps if step in scores), key=lambda step: (scores[step], step), default=None)
        return [step == best or step in steps[-self._keep_latest :] for step in steps]

    def _known_scores(self) -> dict[int, float]:
        if self._scores is None:
            self._scores = {}
            for step in self.steps():
                try:
                    metrics = self.record(step)["metrics"]
                except CheckpointError:
                    continue  # damaged: named when it is restored, never the best
                if SCORE in metrics:
                    self._scores[step] = metrics[SCORE]
        present = self.steps()
        self._scores = {step: score for step, score in self._scores.items() if step in present}
        return self._scores

    def _first_readable(self, steps: list[int], template: Any) -> tuple[int, Any] | None:
        for step in steps:
            try:
                return step, self._read(step, template)
            except ForeignCheckpoint:
                raise
            except CheckpointError as error:
                self._damaged = sorted({*self._damaged, step})
                if jax.process_index() == 0:
                    sys.stderr.write(f"jprimfit: {str(error).removesuffix('.')}: an older one is taken.\n")
        if steps:
            raise CheckpointError(
                f"{self.folder} holds no checkpoint that can be read, all {len(steps)} are damaged: "
                "start anew with --fresh."
            )
        return None

    def _read(self, step: int, template: Any) -> Any:
        place, record, wanted = self.folder / str(step), self.record(step), _named(template)
        leaves = record["leaves"]
        difference = _first_difference(leaves, {name: _described(leaf) for name, leaf in wanted.items()})
        if difference:
            raise ForeignCheckpoint(
                f"{place} is a checkpoint of another network, {difference}: use the config it was made with, "
                "or another workdir."
            )
        empty = {name: np.zeros(spec["shape"], jnp.dtype(spec["dtype"])) for name, spec in leaves.items()}
        stored = {name: value for name, value in empty.items() if value.size}
        as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in stored}
        with _sentences(f"{place} is damaged"):
            items = ocp.args.PyTreeRestore(item=stored, restore_args=as_numpy)  # pyright: ignore[reportCallIssue]
            with _quiet_threads():
                values = empty | self._manager.restore(step, args=ocp.args.Composite(state=items))["state"]
            for name, value in values.items():
                if _described(value) != {k: leaves[name][k] for k in ("dtype", "shape")}:
                    raise ValueError(f"{name} has another shape or type than its record says")
                if _crc(value) != leaves[name]["crc32"]:
                    raise ValueError(f"{name} has other bits than were saved")
        placed = [_placed(values[name], leaf) for name, leaf in wanted.items()]
        return jax.tree.unflatten(jax.tree.structure(template), placed)

    def _put_aside(self) -> None:
        """Renames the damaged checkpoints: a step that is taken would never be written again."""
        self.wait()
        if jax.process_index() == 0:
            for step in self._damaged:
                place, aside = self.folder / str(step), self.folder / f"damaged-{step}"
                number = 1
                while aside.exists():
                    number += 1
                    aside = self.folder / f"damaged-{step}-{number}"
                if place.exists():
                    place.rename(aside)
        if jax.process_count() > 1:
            multihost_utils.sync_global_devices("damaged checkpoints are put aside")
        self._damaged = []
        self._manager.reload()


@contextmanager
def _sentences(what: str) -> Iterator[None]:
    """Turns whatever a library raises, bare Exceptions included, into one sentence that begins with `what`."""
    try:
        yield
    except CheckpointError:
        raise
    except Exception as error:
        words = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
        reason = " ".join(words.split(" [tensorstore_spec")[0].split()).rstrip(".")
        reason = reason[:MAX_REASON] + " ..." * (len(reason) > MAX_REASON) or type(error).__name__
        raise CheckpointError(f"{what} ({reason.replace('. ', '; ')}).") from error


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Drops what Python prints when one read fails and the others, still under way, report to a loop that is closed."""
    previous = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            previous(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    except Exception:
        time.sleep(STRAGGLERS)
        raise
    finally:
        sys.unraisablehook = previous


def _record(step: int, leaves: Mapping[str, np.ndarray], metrics: Mapping[str, float], config: Mapping) -> dict:
    record = {
        "format": FORMAT,
        "version": VERSION,
        "step": step,
        "metrics": {name: float(value) for name, value in metrics.items() if math.isfinite(value)},
        "config": dict(config),
        "leaves": {name: {**_described(leaf), "crc32": _crc(leaf)} for name, leaf in leaves.items()},
    }
    return {**record, "crc32": _crc_of_json(record)}


def _crc_of_json(record: Mapping[str, Any]) -> int:
    """Of all but the field crc32, in a form that a tuple and the list it comes back as share."""
    fields = {name: value for name, value in record.items() if name != "crc32"}
    return zlib.crc32(json.dumps(fields, sort_keys=True).encode())


def _named(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree, in order, under dotted names."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def _copied(name: str, leaf: Any) -> np.ndarray:
    """A copy on the host that nobody else writes to."""
    if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable:
        if not leaf.is_fully_replicated:
            raise CheckpointError(f"{name} is spread over processes: gather it before it is saved.")
        leaf = leaf.addressable_data(0)
    return np.array(leaf)


def _described(leaf: Any) -> dict[str, Any]:
    leaf = leaf if hasattr(leaf, "dtype") else np.asarray(leaf)
    return {"dtype": jnp.dtype(leaf.dtype).name, "shape": list(leaf.shape)}


def _crc(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)


def _first_difference(stored: Mapping[str, Mapping], wanted: Mapping[str, Mapping]) -> str:
    """The first leaf that is not in both alike, in words; empty where all agree."""
    for name in dict.fromkeys((*wanted, *stored)):
        if name not in stored:
            return f"which lacks {name}"
        if name not in wanted:
            return f"which has {name} in addition"
        there, here = ({k: spec[name][k] for k in ("dtype", "shape")} for spec in (stored, wanted))
        if there != here:
            words = (f"{spec['dtype']} {tuple(spec['shape'])}" for spec in (there, here))
            return f"in which {name} is {' instead of '.join(words)}"
    return ""


def _placed(value: np.ndarray, like: Any) -> Any:
    """The value as the template has it: on its devices, an array of NumPy, or a plain number."""
    if isinstance(like, jax.Array | jax.ShapeDtypeStruct):
        sharding = like.sharding
        if sharding is None or (isinstance(like, jax.Array) and not like.committed):
            return jnp.array(value)
        return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])
    return value if isinstance(like, np.ndarray | np.generic) else type(like)(value)
