"""The command line around the commands: which words there are, and that every failure is one sentence and a code."""

import subprocess
import sys

import pytest

from jprimfit.apps import fit
from jprimfit.apps.main import main


def _refusal(capsys, words):
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.endswith(".\n")
    return err


def test_help_lists_what_is_built_and_nothing_else(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    out = capsys.readouterr().out
    assert stop.value.code == 0 and "fit" in out and "demo" in out and "examples:" in out
    assert "assemble" not in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["assemble", "scene.json"], "'assemble' is not built yet: use one of fit, demo"),
        (["paint"], "'paint' is no command of jprimfit: use one of fit, demo"),
    ],
)
def test_other_words_are_one_sentence(capsys, words, message):
    assert message in _refusal(capsys, words)


@pytest.mark.parametrize("words", [[], ["fit"], ["fit", "a.ply"], ["fit", "a.ply", "--out", "b", "--filter", "maybe"]])
def test_wrong_usage_has_exit_code_2(capsys, words):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2 and "usage: jprimfit" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("the scan is\nlate."), "fit: the scan is late."),
        (
            PermissionError(13, "Permission denied", "/somewhere"),
            "fit: /somewhere: Permission denied; choose another place",
        ),
        (MemoryError(), "fit: there is not enough memory"),
    ],
)
def test_failures_of_a_command_are_one_sentence(capsys, monkeypatch, error, message):
    def broken(arguments):
        raise error

    monkeypatch.setattr(fit, "run", broken)
    assert message in _refusal(capsys, ["fit", "a.ply", "--out", "b"])


def test_an_interruption_says_so(capsys, monkeypatch):
    def stopped(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(fit, "run", stopped)
    assert main(["fit", "a.ply", "--out", "b"]) == 130
    assert "nothing is half written" in capsys.readouterr().err


def test_a_fault_of_our_own_keeps_its_traceback(monkeypatch):
    def wrong(arguments):
        raise TypeError("a fault")

    monkeypatch.setattr(fit, "run", wrong)
    with pytest.raises(TypeError, match="a fault"):
        main(["fit", "a.ply", "--out", "b"])


def test_the_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "jprimfit", "fit", "absent.ply", "--out", "x"], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr == "jprimfit: fit: absent.ply does not exist: check the name.\n"
