"""A training as a whole: what it leaves behind, how it stops, and that a stopped one ends like any other."""

import os
import signal
import threading

import jax
import numpy as np
import pytest

from jprimfit.networks import weights
from jprimfit.training import loop
from jprimfit.training.checkpoint import Checkpoints
from jprimfit.training.config import from_mapping
from jprimfit.training.loop import NotFinite, train
from jprimfit.training.validation import SCORES
from jprimfit.training.writer import read

pytestmark = pytest.mark.usefixtures("toy_loader")


def config(toy_mapping, **changes):
    toy_mapping["train"] |= changes
    return from_mapping(toy_mapping, source="c.yaml")


def final_bytes(folder):
    """The exported weights after the last step, and all that the last checkpoint holds."""
    with Checkpoints(folder / "checkpoints", read_only=True) as checkpoints:
        last = checkpoints.steps()[-1]
        record = checkpoints.record(last)
    return (folder / "last" / "weights.npz").read_bytes(), last, record["leaves"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A folder for the run that others are compared with; filled by the first test that needs it."""
    return tmp_path_factory.mktemp("undisturbed") / "run"


def undisturbed_run(folder, toy_mapping):
    if not folder.exists():
        train(config(toy_mapping), folder)
    return folder


def test_a_run_learns_and_leaves_its_curve_checkpoints_and_models(undisturbed, toy_mapping, toy_loader, capsys):
    outcome = train(config(toy_mapping), undisturbed)
    assert outcome.step == 30 and outcome.signal is None and outcome.reason == "all steps are made"
    lines = read(undisturbed)
    losses = {line["step"]: line["total"] for line in lines if line["kind"] == "train"}
    scores = {line["step"]: line["miou"] for line in lines if line["kind"] == "validation"}
    assert list(losses) == [5, 10, 15, 20, 25, 30] and losses[30] < 0.8 * losses[5]
    assert list(scores) == [10, 20, 30] and outcome.best == max(scores.values())
    assert all(line["learning_rate"] == pytest.approx(1e-2) for line in lines if line["kind"] == "train")
    best, last = (weights.load(undisturbed / name) for name in ("best", "last"))
    assert last.info["steps"] == 30 and scores[best.info["steps"]] == outcome.best
    assert sorted(set(toy_loader.asked)) == list(range(30))
    shown = capsys.readouterr().err
    assert "3 parts have no instance or more than data.max_instances = 4: left out" in shown
    assert "from the beginning, to step 30" in shown and "step 30: validation mIoU" in shown
    again = train(config(toy_mapping), undisturbed)
    assert (again.step, again.best) == (30, outcome.best)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_the_resumed_run_ends_bit_for_bit_alike(
    undisturbed, toy_mapping, toy_loader, tmp_path, number, capsys
):
    expected = final_bytes(undisturbed_run(undisturbed, toy_mapping))

    def stop(step, batch):
        if step == 13:
            signal.pthread_kill(threading.main_thread().ident, number)
        return batch

    toy_loader.change = stop
    outcome = train(config(toy_mapping), tmp_path / "run")
    assert outcome.signal == number and 11 <= outcome.step <= 15
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert f"to step {outcome.step}" not in capsys.readouterr().err
    toy_loader.change = lambda step, batch: batch
    assert train(config(toy_mapping, parallel="pmap", log_every=3), tmp_path / "run").step == 30
    assert f"resumed from step {outcome.step}" in capsys.readouterr().err
    assert final_bytes(tmp_path / "run") == expected
    steps = [line["step"] for line in read(tmp_path / "run") if line["kind"] == "validation"]
    assert steps == [10, 20, 30]


def test_the_time_limit_saves_validates_and_exports(toy_mapping, tmp_path):
    outcome = train(config(toy_mapping, time_limit_minutes=1e-9), tmp_path / "run")
    assert (outcome.step, outcome.reason) == (1, "time limit") and outcome.best is not None
    assert final_bytes(tmp_path / "run")[1] == 1
    assert weights.load(tmp_path / "run").info["steps"] == 1


def test_a_loss_that_is_not_finite_stops_with_its_step(toy_mapping, toy_loader, tmp_path):
    def spoil(step, batch):
        return batch if step != 8 else batch._replace(points=np.full_like(batch.points, np.nan))

    toy_loader.change = spoil
    with pytest.raises(NotFinite, match=r"the loss of step 9 is not finite .*; step 5 is the last that was saved\."):
        train(config(toy_mapping), tmp_path / "run")
    with Checkpoints(tmp_path / "run" / "checkpoints", read_only=True) as checkpoints:
        assert checkpoints.steps() == (5,)


def test_steps_that_are_not_finite_may_be_left_out(toy_mapping, toy_loader, tmp_path, capsys):
    def spoil(step, batch):
        return batch if step not in spoilt else batch._replace(points=np.full_like(batch.points, np.nan))

    toy_loader.change, spoilt = spoil, {6, 8}
    toy_mapping["optimizer"] = {**toy_mapping.get("optimizer", {}), "skip_non_finite": 1}
    outcome = train(config(toy_mapping), tmp_path / "run")
    assert outcome.reason == "all steps are made"
    assert "step 9 is not finite (loss nan, gradient nan): left out, 2 so far" in capsys.readouterr().err
    lines = [line for line in read(tmp_path / "run") if line["kind"] == "train"]
    assert sum(line["skipped"] for line in lines) == 2 and all(np.isfinite(line["total"]) for line in lines)
    assert np.isfinite(outcome.best)
    spoilt = {6, 7}
    with pytest.raises(NotFinite, match=r"the loss of step 8 is not finite .*, nor were the 1 before it"):
        train(config(toy_mapping), tmp_path / "again")


def test_points_all_in_one_segment_are_noticed(toy_mapping, toy_loader, tmp_path, capsys, monkeypatch):
    def collapsed(segmenter, *, pooled):
        return lambda variables, batches: {**dict.fromkeys(SCORES, 0.1), "num_segments": 1.2}

    monkeypatch.setattr(loop, "validator", collapsed)
    train(config(toy_mapping, steps=2), tmp_path / "run")
    assert "warning: 1.2 segments are found per cloud" in capsys.readouterr().err


def test_other_settings_are_refused_and_fresh_begins_anew(undisturbed, toy_mapping, tmp_path):
    folder = tmp_path / "run"
    train(config(toy_mapping, steps=2), folder)
    toy_mapping["seed"] = 9
    with pytest.raises(ValueError, match="holds a run with other settings of seed"):
        train(config(toy_mapping), folder)
    assert train(config(toy_mapping, steps=1), folder, fresh=True).step == 1
    assert final_bytes(tmp_path / "run.1")[1] == 2 and final_bytes(folder)[1] == 1


def test_more_steps_may_follow(toy_mapping, tmp_path, undisturbed):
    expected = final_bytes(undisturbed_run(undisturbed, toy_mapping))
    assert train(config(toy_mapping, steps=10), tmp_path / "run").step == 10
    assert train(config(toy_mapping, steps=30), tmp_path / "run").step == 30
    assert final_bytes(tmp_path / "run") == expected


def test_a_run_from_a_model_goes_on_without_it_and_counts_its_clouds(toy_mapping, tmp_path):
    train(config(toy_mapping, steps=3), tmp_path / "first")
    second = tmp_path / "second"
    toy_mapping["train"]["start_from"] = str(tmp_path / "first" / "last")
    train(config(toy_mapping, steps=2), tmp_path / "whole")
    train(config(toy_mapping, time_limit_minutes=1e-9), second)
    info = weights.load(second / "last").info
    assert info["clouds_seen"] == 8 * (3 + 1) and info["settings"]["train"]["start_from"] == "first"
    (tmp_path / "first").rename(tmp_path / "moved")
    assert train(config(toy_mapping, time_limit_minutes=None), second).step == 2
    assert weights.load(second / "last").info["clouds_seen"] == 8 * (3 + 2)
    assert final_bytes(second) == final_bytes(tmp_path / "whole")
    with pytest.raises(ValueError, match="first/last' is no model"):
        train(config(toy_mapping), tmp_path / "third")


def test_an_error_in_the_loader_arrives(toy_mapping, toy_loader, tmp_path):
    def fail(step, batch):
        if step == 3:
            raise ValueError("the disk is gone")
        return batch

    toy_loader.change = fail
    with pytest.raises(ValueError, match="the disk is gone"):
        train(config(toy_mapping), tmp_path / "run")
    assert not any(thread.name == "prefetch" for thread in threading.enumerate())


def test_both_ways_of_running_agree(toy_mapping, tmp_path, undisturbed):
    expected = weights.load(undisturbed_run(undisturbed, toy_mapping) / "last").variables
    train(config(toy_mapping, parallel="shard_map"), tmp_path / "run")
    found = weights.load(tmp_path / "run" / "last").variables
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=5e-3), found, expected)
    assert os.path.exists(tmp_path / "run" / "config.yaml")
