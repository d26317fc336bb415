"""Whose a workdir is, and what happens to an old run."""

import pytest

from jprimfit import settings
from jprimfit.training import workdir
from jprimfit.training.config import from_mapping


@pytest.fixture
def config(toy_mapping):
    return from_mapping(toy_mapping, source="c.yaml")


def change(toy_mapping, **changes):
    return from_mapping({**toy_mapping, **changes}, source="c.yaml")


def test_settings_are_kept_and_the_same_ones_may_come_again(tmp_path, config):
    folder = tmp_path / "runs" / "a"
    for _ in range(2):
        with workdir.prepared(folder, config, fresh=False):
            pass
    assert from_mapping(settings.read_yaml(folder / "config.yaml"), source="kept") == config


def test_other_settings_are_refused_by_name(tmp_path, config, toy_mapping):
    with workdir.prepared(tmp_path, config, fresh=False):
        pass
    other = change(toy_mapping, seed=7, optimizer={"learning_rate": 1})
    with pytest.raises(ValueError, match=r"other settings of optimizer.learning_rate, seed: set them as they were"):
        with workdir.prepared(tmp_path, other, fresh=False):
            pass
    assert from_mapping(settings.read_yaml(tmp_path / "config.yaml"), source="kept") == config


def test_fresh_puts_the_old_run_aside(tmp_path, config, toy_mapping):
    folder = tmp_path / "a"
    for number in range(3):
        with workdir.prepared(folder, change(toy_mapping, seed=number), fresh=True):
            (folder / f"result-{number}").touch()
    assert (folder / "result-2").exists() and not (folder / "result-1").exists()
    assert (tmp_path / "a.1" / "result-0").exists() and (tmp_path / "a.2" / "result-1").exists()


@pytest.mark.parametrize("place", ["", "last"])
def test_fresh_does_not_put_aside_what_it_starts_from(tmp_path, config, toy_mapping, place):
    folder = tmp_path / "a"
    with workdir.prepared(folder, config, fresh=False):
        pass
    toy_mapping["train"]["start_from"] = str(tmp_path / "b" / ".." / "a" / place)
    with pytest.raises(ValueError, match=r"lies in .*, which --fresh would rename: give another --workdir\."):
        with workdir.prepared(folder, from_mapping(toy_mapping, source="c.yaml"), fresh=True):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_of_other_things_is_left_alone(tmp_path, config):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match="holds files, but no config.yaml of a run"):
        with workdir.prepared(tmp_path, config, fresh=False):
            pass


def test_two_trainings_do_not_share_a_folder(tmp_path, config):
    with workdir.prepared(tmp_path, config, fresh=False):
        for fresh in (False, True):
            with pytest.raises(ValueError, match="is in use by another training"):
                with workdir.prepared(tmp_path, config, fresh=fresh):
                    pass
    with workdir.prepared(tmp_path, config, fresh=False):
        pass
