"""What a person who watches a training sees on stderr: a bar on a terminal, a line now and then in a log."""

import sys
import time
from typing import Any

from tqdm import tqdm

SMOOTHING = 0.98  # of the shown loss, per step


class Progress:
    """Counts steps; shows the smoothed loss, the clouds per second and the time left. Silent where not shown."""

    def __init__(self, *, first: int, last: int, batch_size: int, shown: bool = True, stream: Any = None):
        self._stream = sys.stderr if stream is None else stream
        self._last, self._batch_size, self._shown = last, batch_size, shown
        self._loss: float | None = None
        self._mark = (time.monotonic(), first)
        self._bar: Any = None
        if shown and self._stream.isatty():
            self._bar = tqdm(total=last, initial=first, file=self._stream, unit="step", mininterval=0.5, smoothing=0.05)

    def step(self, loss: float | None) -> None:
        """To be called after every step with its loss, None where that is not finite."""
        if loss is not None:
            self._loss = loss if self._loss is None else SMOOTHING * self._loss + (1 - SMOOTHING) * loss
        if self._bar is not None:
            self._bar.set_postfix_str("" if self._loss is None else f"loss {self._loss:.4f}", refresh=False)
            self._bar.update(1)

    def report(self, done: int) -> float:
        """Clouds per second since the last report, whatever else was done meanwhile; a line where there is no bar."""
        (before, count), now = self._mark, time.monotonic()
        speed = (done - count) * self._batch_size / max(now - before, 1e-9)
        self._mark = (now, done)
        if self._bar is None and self._shown and self._loss is not None:
            left = (self._last - done) * self._batch_size / max(speed, 1e-9)
            self.say(f"step {done}/{self._last}   loss {self._loss:.4f}   {speed:.1f} clouds/s   {clock(left)} left")
        elif self._bar is not None:
            self._bar.set_description_str(f"{speed:.1f} clouds/s", refresh=False)
        return speed

    def say(self, line: str) -> None:
        """A line that does not break the bar."""
        if self._bar is not None:
            tqdm.write(line, file=self._stream)
        elif self._shown:
            self._stream.write(line + "\n")
            self._stream.flush()

    def close(self) -> None:
        """Ends the bar."""
        if self._bar is not None:
            self._bar.close()


def clock(seconds: float) -> str:
    """A duration as people say it: 40 s, 12 min, 3 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
