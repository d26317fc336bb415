"""A training from its settings to exported weights: resumes, validates, saves, and ends in good order.

The parameters after step s depend on the settings and s alone, not on how often the run was stopped: batches and random
keys follow from the step, and what is saved is everything that the next step reads.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jprimfit import settings
from jprimfit.data.loader import prefetch
from jprimfit.networks.segmenter import Segmenter
from jprimfit.training import parallel, state, workdir
from jprimfit.training.checkpoint import Checkpoints
from jprimfit.training.config import Config, num_steps
from jprimfit.training.export import export
from jprimfit.training.progress import Progress
from jprimfit.training.sources import Sources, open_sources, validation_batches
from jprimfit.training.step import CLOUD, Batch, initial_variables, start_model, train_step
from jprimfit.training.validation import SCORES, validator
from jprimfit.training.writer import Writer, read

PREFETCHED = 2  # batches that are drawn while the devices work
AGREE_EVERY = 10  # steps after which several processes ask each other whether to stop
COLLAPSED = 1.5  # segments found per validation cloud, below which the network puts all points into one
CLOUDS_SEEN = "clouds_seen"  # in exported models and checkpoints: by this run and by the models that it goes back to


class NotFinite(RuntimeError):
    """The loss or its gradient is not finite; its message is the sentence for the user."""


class Outcome(NamedTuple):
    """How a training ended."""

    step: int  # updates made in the whole run
    reason: str  # "all steps are made", "time limit" or "signal"
    signal: int | None  # the one that stopped it
    best: float | None  # highest validation mIoU of the whole run


def train(config: Config, folder: Path, *, fresh: bool = False) -> Outcome:
    """Trains in a folder, from its newest readable checkpoint if it has one; all processes of a run call it.

    ValueError where folder and settings do not fit (see workdir.prepare), NotFinite where the loss is lost. On
    SIGTERM and SIGINT and at the time limit it saves, and returns what it has.
    """
    began = time.monotonic()
    with contextlib.ExitStack() as stack:
        if parallel.is_writer():
            stack.enter_context(workdir.prepared(folder, config, fresh=fresh))
        parallel.agreed(True)  # the others wait until the folder is there
        signals = stack.enter_context(_signals())
        sources = open_sources(config)
        stack.callback(sources.training.close)
        checkpoints = stack.enter_context(Checkpoints(folder / "checkpoints", config=settings.to_mapping(config)))
        cloud = jax.tree.map(lambda x: x[0], sources.training.batch(0, 1))
        variables = initial_variables(Segmenter(config.model), cloud, config=config)
        start = _start(config, checkpoints, variables)
        resumed_step = int(start.state.step) if start.resumed else None
        writer = stack.enter_context(Writer(folder, tensorboard=config.train.tensorboard, resumed_step=resumed_step))
        run = _Run(config, folder, sources, checkpoints, writer, signals, start)
        run.greet(resumed=start.resumed)
        return run.to_the_end(began)


class _Start(NamedTuple):
    """What a call of train begins with."""

    state: state.TrainState
    resumed: bool
    clouds_before: int  # that had been seen when the run was at step 0


def _start(config: Config, checkpoints: Checkpoints, variables: Any) -> _Start:
    """The newest checkpoint; else the model of train.start_from, which a resumed run needs no more; else variables."""
    initial = state.create(variables, config=config.optimizer)
    found = checkpoints.restore(initial)
    if found is not None:
        step, restored = found
        seen = step * config.train.batch_size
        return _Start(restored, True, round(checkpoints.record(step)["metrics"].get(CLOUDS_SEEN, seen)) - seen)
    model = start_model(config)
    if model is None:
        return _Start(initial, False, 0)
    before = model.info.get(CLOUDS_SEEN)
    first = state.create(model.variables, config=config.optimizer)
    return _Start(first, False, before if isinstance(before, int) else 0)


class _Run:
    """One call of train: the state, and what has to be done when."""

    def __init__(
        self,
        config: Config,
        folder: Path,
        sources: Sources,
        checkpoints: Checkpoints,
        writer: Writer,
        signals: list[int],
        start: _Start,
    ):
        self.config, self.folder, self.sources = config, folder, sources
        self.checkpoints, self.writer, self.signals = checkpoints, writer, signals
        self.clouds_before = start.clouds_before
        self.step, self.num_steps = int(start.state.step), num_steps(config.train, sources.num_clouds)
        self.num_parameters = sum(x.size for x in jax.tree.leaves(start.state.params))
        segmenter = Segmenter(config.model, axis_names=(CLOUD, parallel.AXIS))
        self.devices = parallel.parallelise(
            train_step(segmenter, config=config, num_steps=self.num_steps),
            kind=config.train.parallel,
            num_devices=config.train.devices,
        )
        if config.train.batch_size % (self.devices.num_devices * config.train.accumulate):
            in_parts = f" in {config.train.accumulate} parts each (train.accumulate)" * (config.train.accumulate > 1)
            raise ValueError(
                f"train.batch_size is {config.train.batch_size}, which {self.devices.num_devices} devices cannot share "
                f"equally{in_parts}: give a multiple."
            )
        self.state = self.devices.replicate(start.state)
        self.validate = validator(Segmenter(config.model), pooled=config.model.types == "pooled")
        self.best = max((line["miou"] for line in read(folder) if line["kind"] == "validation"), default=None)
        self.progress = Progress(
            first=self.step,
            last=self.num_steps,
            batch_size=config.train.batch_size,
            shown=parallel.is_writer(),
        )
        self.window: list[dict[str, float]] = []  # of the updates since the last line in the log
        self.skipped, self.skipped_in_a_row, self.skipped_in_all = 0, 0, 0  # since that line; up to now; in this call

    def greet(self, *, resumed: bool) -> None:
        """Says what is about to happen."""
        begin = f"resumed from step {self.step}" if resumed else "from the beginning"
        self.progress.say(
            f"{self.folder}: {begin}, to step {self.num_steps}; {self.num_parameters:,} parameters, "
            f"{self.sources.num_clouds} clouds, {self.devices.num_devices} x {jax.devices()[0].device_kind}"
        )
        left_out = self.sources.training.num_left_out
        if left_out:
            most = self.config.data.max_instances
            self.progress.say(f"{left_out} parts have no instance or more than data.max_instances = {most}: left out")

    def to_the_end(self, began: float) -> Outcome:
        """Steps until all are made or something stops the run; then everything is saved and exported."""
        train, reason, pending = self.config.train, "", None
        batches = self._batches()
        try:
            for batch in batches:
                self.state, metrics = self.devices.step(self.state, self.devices.shard(batch))
                # One step late, while the devices are at the next one.
                self._take(self.step, pending)
                self.step, pending = self.step + 1, metrics
                reason = self._stop_reason(began)
                due = _is_due(self.step, train.validate_every) or (reason and reason != "signal")
                if due or reason or _is_due(self.step, train.checkpoint_every) or _is_due(self.step, train.log_every):
                    self._take(self.step, pending)
                    pending = None
                if _is_due(self.step, train.log_every) or reason:
                    self._log()
                if due or reason or _is_due(self.step, train.checkpoint_every):
                    self._save(self._validated() if due else None)
                if reason:
                    break
        finally:
            batches.close()
            self.progress.close()
        return self._ended(reason)

    def _batches(self) -> Generator[Batch]:
        """The batches from here to the end, of each the rows of this process, made ahead."""
        size = self.config.train.batch_size
        rows = parallel.share(size)
        row = np.arange(rows.start, rows.stop, dtype=np.int32)
        ahead = prefetch(
            self.sources.training,
            first_step=self.step,
            last_step=self.num_steps,
            batch_size=size,
            shard=parallel.place(),
            depth=PREFETCHED,
        )
        with contextlib.closing(ahead):
            for _, example in ahead:
                yield Batch(example, row)

    def _take(self, step: int, metrics: Any) -> None:
        """Fetches the metrics of the step that made `step` steps, and stops the run where they are not finite."""
        if metrics is None:
            return
        values = {name: float(value) for name, value in self.devices.first(metrics).items()}
        if values.pop("finite"):
            self.skipped_in_a_row = 0
            self.window.append(values)
            self.progress.step(values["total"])
            return
        self.skipped, self.skipped_in_all = self.skipped + 1, self.skipped_in_all + 1
        self.skipped_in_a_row += 1
        what = f"step {step} is not finite (loss {values['total']:g}, gradient {values['gradient_norm']:g})"
        if self.skipped_in_a_row <= self.config.optimizer.skip_non_finite:
            self.progress.say(f"{what}: left out, {self.skipped_in_all} so far")
            self.progress.step(None)
            return
        saved = self.checkpoints.steps()
        before = f", nor were the {self.skipped_in_a_row - 1} before it" * (self.skipped_in_a_row > 1)
        raise NotFinite(
            f"the loss of {what}{before}: lower optimizer.learning_rate or set optimizer.clip_norm; "
            f"{f'step {saved[-1]} is the last that was saved' if saved else 'nothing was saved yet'}."
        )

    def _log(self) -> None:
        """One line in metrics.jsonl: the means since the last one."""
        speed = self.progress.report(self.step)
        if self.window:
            means = {name: float(np.mean([values[name] for values in self.window])) for name in self.window[0]}
            scalars = {**means, "skipped": float(self.skipped), "clouds_per_second": speed}
            self.writer.write(self.step, kind="train", scalars=scalars)
        self.window, self.skipped = [], 0

    def _validated(self) -> dict[str, float]:
        """Scores of the present weights; the best so far are exported."""
        scores = dict.fromkeys(SCORES, 0.0)
        if parallel.is_writer():
            present = self.devices.first(self.state)
            scores = self.validate(
                state.variables(present),
                validation_batches(self.sources.validation, self.config.train.validation_batch_size),
            )
            self.writer.write(self.step, kind="validation", scalars=scores)
            self.progress.say(
                f"step {self.step}: validation mIoU {100 * scores['miou']:.1f} %, types "
                f"{100 * scores['type_accuracy']:.1f} %, normals {scores['normal_deg']:.1f} deg"
            )
            if scores["num_segments"] < COLLAPSED:
                self.progress.say(
                    f"warning: {scores['num_segments']:.1f} segments are found per cloud, nearly all points are in "
                    "one: lower optimizer.learning_rate if this does not pass"
                )
            if self.best is None or scores["miou"] > self.best:
                self._export(present, workdir.BEST, scores)
        scores = {name: float(value) for name, value in parallel.from_writer(scores).items()}
        self.best = scores["miou"] if self.best is None else max(self.best, scores["miou"])
        return scores

    def _export(self, present: state.TrainState, name: str, scores: dict[str, float]) -> None:
        export(present, self.config, self.folder / name, info={CLOUDS_SEEN: self._clouds_seen(), "validation": scores})

    def _save(self, scores: dict[str, float] | None) -> None:
        metrics = {**(scores or {}), CLOUDS_SEEN: float(self._clouds_seen())}
        self.checkpoints.save(self.step, self.devices.first(self.state), metrics)

    def _clouds_seen(self) -> int:
        return self.clouds_before + self.step * self.config.train.batch_size

    def _ended(self, reason: str) -> Outcome:
        if parallel.is_writer():
            self._export(self.devices.first(self.state), workdir.LAST, {})
        self.checkpoints.wait()
        stopped = self.signals[0] if reason == "signal" and self.signals else None
        return Outcome(self.step, reason or "all steps are made", stopped, self.best)

    def _stop_reason(self, began: float) -> str:
        """Why this step is the last one, "" if it is not. Several processes come to the same answer."""
        if self.step >= self.num_steps:
            return "all steps are made"
        if jax.process_count() > 1 and self.step % AGREE_EVERY:
            return ""
        limit = self.config.train.time_limit_minutes
        if parallel.agreed(bool(self.signals)):
            return "signal"
        late = limit is not None and time.monotonic() - began >= 60 * limit
        return "time limit" if parallel.agreed(late) else ""


def _is_due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """The list of stop signals that have arrived; the second SIGINT ends the program at once."""
    arrived: list[int] = []

    def note(number: int, frame: Any) -> None:
        if number == signal.SIGINT and arrived:
            raise KeyboardInterrupt
        arrived.append(number)

    previous = {}
    in_main = threading.current_thread() is threading.main_thread()  # the only one that may handle signals
    try:
        for number in (signal.SIGINT, signal.SIGTERM) if in_main else ():
            previous[number] = signal.signal(number, note)
        yield arrived
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
