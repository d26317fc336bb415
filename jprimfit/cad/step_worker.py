"""STEP files read by a process of its own: OpenCASCADE dies of some broken files, and of others never comes back.

A file with a reference to nothing is enough for a segmentation fault. The process reads one file after the other; when
it is lost with a file, that file is refused in one sentence and the next one gets a new process.
"""

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from jprimfit.cad import step, step_reader

LIMIT_SECONDS = 600.0  # for one file


class Reader:
    """read_step, or another function of a path, in another process; use it in a with statement.

    limit is the time in seconds that one file may take.
    """

    def __init__(self, read: Callable[[Path], Any] = step_reader.read_step, *, limit: float = LIMIT_SECONDS):
        self._read, self._limit = read, limit
        self._process, self._pipe = None, None

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, path: str | os.PathLike[str]) -> step_reader.Contents:
        """What step_reader.read_step gives or raises; ValueError also where OpenCASCADE dies or takes too long."""
        if not step.available():
            raise ValueError(step.NOT_INSTALLED)
        if self._process is None:
            self._start()
        pipe: Any = self._pipe
        try:
            pipe.send(str(path))
            if not pipe.poll(self._limit):
                self.close()
                words = f"it takes OpenCASCADE more than {self._limit:g} s; repair or divide it"
                raise ValueError(f"{path} cannot be read: {words}.")
            good, answer = pipe.recv()
        except (EOFError, OSError):
            self.close()
            words = "OpenCASCADE crashed on it, so it is broken; export it again"
            raise ValueError(f"{path} cannot be read: {words}.") from None
        if not good:
            raise ValueError(answer)
        return answer

    def close(self) -> None:
        """Ends the process."""
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = self._pipe = None

    def _start(self) -> None:
        context = get_context("spawn")  # a fork would inherit the threads of JAX
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._read), daemon=True)
        self._process.start()
        theirs.close()


def serve(pipe: Connection, read: Callable[[Path], Any]) -> None:
    """Answers paths from the pipe with (True, contents) or (False, sentence) until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches this process too; the other one ends it
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # OpenCASCADE prints there without being asked
    with suppress(EOFError):
        while True:
            path = Path(pipe.recv())
            try:
                answer = True, read(path)
            except ValueError as error:
                answer = False, str(error)
            pipe.send(answer)
