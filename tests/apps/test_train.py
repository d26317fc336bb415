"""`jprimfit train` and train.py: what they say, what they return, and that kill -9 changes no bit of the answer."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jprimfit.apps.main import main
from jprimfit.training.checkpoint import Checkpoints
from jprimfit.training.loop import NotFinite, Outcome
from jprimfit.training.writer import read

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "configs" / "tiny.yaml"


@pytest.fixture
def calls(monkeypatch):
    """Replaces the training by a note of what was asked for; its last entry is the answer, or the error."""
    asked = [Outcome(300, "all steps are made", None, 0.5)]

    def train(config, folder, *, fresh):
        asked.insert(0, (config, folder, fresh))
        if isinstance(asked[-1], Exception):
            raise asked[-1]
        return asked[-1]

    monkeypatch.setattr("jprimfit.training.loop.train", train)
    return asked


def test_settings_folder_and_ending_are_passed_on(calls, capsys):
    assert main(["train", "--config", str(TINY), "train.steps=7", "optimizer.learning_rate=1e-4"]) == 0
    config, folder, fresh = calls[0]
    assert (config.train.steps, config.optimizer.learning_rate) == (7, 1e-4)
    assert folder == Path("runs/tiny") and not fresh
    assert capsys.readouterr().err == ("runs/tiny: all steps are made at step 300, best validation mIoU 50.0 %.\n")
    assert main(["train", "--config", str(TINY), "--workdir", "elsewhere", "--fresh"]) == 0
    assert calls[0][1:] == (Path("elsewhere"), True)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_shows_in_the_exit_code(calls, number, code):
    calls[-1] = Outcome(7, "signal", int(number), None)
    assert main(["train", "--config", str(TINY)]) == code


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["optimizer.lr=1"], "unknown key 'optimizer.lr' in"),
        (["train.steps=many"], "train.steps in"),
        (["train.steps"], "'train.steps' is no setting"),
        (["--num-processes", "2"], "--num-processes and --process-id need the --coordinator host:port"),
        (["--coordinator", "127.0.0.1:1", "--num-processes", "2"], "expected both, with the id"),
    ],
)
def test_what_is_wrong_is_one_sentence(calls, words, sentence, capsys):
    assert main(["train", "--config", str(TINY), *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jprimfit: train: ") and sentence in error and error.count("\n") == 1
    assert len(calls) == 1


def test_a_lost_loss_and_a_missing_file_are_one_sentence(calls, capsys):
    calls[-1] = NotFinite("the loss of step 9 is not finite.")
    assert main(["train", "--config", str(TINY)]) == 2
    assert capsys.readouterr().err == "jprimfit: train: the loss of step 9 is not finite.\n"
    assert main(["train", "--config", "nowhere.yaml"]) == 2
    assert "nowhere.yaml: No such file" in capsys.readouterr().err


SHORT = ["train.steps=24", "train.checkpoint_every=4", "train.validate_every=12", "train.log_every=4"]
SMALL = ["data.num_clouds=16", "validation.num_clouds=8", "data.workers=0", "validation.workers=0"]


def start(folder, cache, *words):
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": os.environ.get("JPRIMFIT_CACHE", str(ROOT / ".cache" / "jax")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    }
    settings = [*SHORT, *SMALL, f"data.cache={cache}", *words]
    return subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), "--config", str(TINY), "--workdir", str(folder), *settings],
        env=environment,
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )


def final(folder):
    """Step and checksums of all leaves of the last checkpoint, and the exported weights."""
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        last = checkpoints.steps()[-1]
        leaves = checkpoints.record(last)["leaves"]
    return last, leaves, (folder / "last" / "weights.npz").read_bytes()


@pytest.mark.slow
def test_kill_9_at_random_moments_changes_no_bit(tmp_path, capsys):
    undisturbed = start(tmp_path / "a", tmp_path / "pools")
    said = undisturbed.communicate()[1]
    assert undisturbed.returncode == 0, said
    # A second time, with everything compiled and prepared, to know how long there is to kill.
    begin = time.monotonic()
    start(tmp_path / "b", tmp_path / "pools").communicate()
    duration = time.monotonic() - begin
    assert final(tmp_path / "a") == final(tmp_path / "b")
    generator, resumed = np.random.default_rng(0), []
    for share in generator.uniform(0.3, 0.9, 3):
        process = start(tmp_path / "c", tmp_path / "pools")
        time.sleep(share * duration)
        process.kill()
        resumed.append(process.communicate()[1].partition("\n")[0].rpartition(": ")[2].partition(",")[0])
        duration = max(0.7 * duration, 8)
    end = start(tmp_path / "c", tmp_path / "pools")
    shown = end.communicate()[1]
    assert end.returncode == 0, shown
    assert final(tmp_path / "c") == final(tmp_path / "a")
    curves = [
        [{k: v for k, v in line.items() if k != "clouds_per_second"} for line in read(tmp_path / name)] for name in "ac"
    ]
    assert [line["step"] for line in curves[0]] == [line["step"] for line in curves[1]]
    assert [line for line in curves[0] if line["kind"] == "validation"] == [
        line for line in curves[1] if line["kind"] == "validation"
    ]
    with capsys.disabled():
        sys.stdout.write(f"\nkilled three times, starts: {resumed}, then {shown.partition(chr(10))[0]}\n")


@pytest.mark.slow
def test_sigterm_saves_and_tells(tmp_path):
    process = start(tmp_path / "a", tmp_path / "pools", "train.log_every=1")
    for line in process.stderr:
        if line.startswith("step 3/"):
            process.send_signal(signal.SIGTERM)
            break
    rest = process.communicate()[1]
    assert process.returncode == 143, rest
    step, _, _ = final(tmp_path / "a")
    assert 3 <= step <= 6 and f"signal at step {step}" in rest
