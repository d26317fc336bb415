"""What is shown of a training."""

import io

import pytest

from jprimfit.training.progress import Progress, clock


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def ticking(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("jprimfit.training.progress.time.monotonic", lambda: now[0])
    return now


def test_a_log_gets_a_line_with_loss_speed_and_time_left(ticking):
    stream = io.StringIO()
    progress = Progress(first=100, last=1100, batch_size=4, stream=stream)
    for _ in range(100):
        progress.step(2.0)
    ticking[0] = 40.0
    assert progress.report(200) == 10.0
    assert stream.getvalue() == "step 200/1100   loss 2.0000   10.0 clouds/s   6 min left\n"


def test_the_loss_is_smoothed(ticking):
    stream = io.StringIO()
    progress = Progress(first=0, last=10, batch_size=1, stream=stream)
    progress.step(1.0)
    progress.step(2.0)
    ticking[0] = 1.0
    progress.report(2)
    assert "loss 1.0200" in stream.getvalue()


def test_a_terminal_gets_a_bar_that_lines_do_not_break(ticking):
    stream = Terminal()
    progress = Progress(first=0, last=3, batch_size=1, stream=stream)
    for _ in range(3):
        progress.step(1.0)
    ticking[0] = 1.0
    assert progress.report(3) == 3.0
    progress.say("a line")
    progress.close()
    assert "loss 1.0000" in stream.getvalue() and "3/3" in stream.getvalue() and "a line\n" in stream.getvalue()


def test_processes_that_do_not_write_are_silent():
    stream = Terminal()
    progress = Progress(first=0, last=3, batch_size=1, shown=False, stream=stream)
    progress.step(1.0)
    progress.report(1)
    progress.say("a line")
    progress.close()
    assert stream.getvalue() == ""


@pytest.mark.parametrize(("seconds", "words"), [(40.0, "40 s"), (720.0, "12 min"), (11_100.0, "3 h 05 min")])
def test_durations_are_as_people_say_them(seconds, words):
    assert clock(seconds) == words
