"""The command `data`: a file and a line come out, counts are shown, refusals are one sentence."""

import re
from pathlib import Path

import pytest
from PIL import Image

from jprimfit import settings
from jprimfit.apps.main import main
from jprimfit.data import families
from jprimfit.data.build import BuildConfig

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "data" / "solids.yaml"
STANDARD = CONFIG.with_name("standard.yaml")


def test_a_small_set_is_built_and_inspected(tmp_path, capsys):
    out = tmp_path / "new" / "few.h5"  # the folder is made
    words = ["data", "build", "--config", str(CONFIG), "--out", str(out), "--workers", "1"]
    assert main([*words, "train=21", "val=2", "test=2", "seed=4"]) == 0
    printed = capsys.readouterr()
    assert (
        re.search(r"few\.h5: 25 parts, \d\.\d MB \(\d\.\d kB a part\), .* parts/s", printed.out)
        and "25/25" in printed.err
    )
    assert main(["data", "inspect", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "25 parts" in shown and "seed = 4" in shown
    for words in ("train: 21 parts", "val: 2 parts", "test: 2 parts", "clevis", "hex_bolt"):
        assert words in shown
    for words, kinds in (("of the instances", 4), ("of the area of a part", 5)):
        lines = [line for line in shown.splitlines() if words in line]
        shares = [[float(share) for share in re.findall(r"(\d+\.\d) %", line)] for line in lines]
        assert [len(some) for some in shares] == [kinds] * 3
        assert [sum(some) for some in shares] == pytest.approx([100] * 3, abs=0.4)


def test_a_sheet_shows_parts_of_every_family(tmp_path, capsys):
    out, sheet = tmp_path / "few.h5", tmp_path / "sheet.png"
    words = ["families.train=[hexagon_nut, spacer_ring]", "families.val=[pipe_plug]", "families.test=[pipe_tee]"]
    assert main(["data", "build", "--out", str(out), "--workers", "1", "train=5", "val=1", "test=1", *words]) == 0
    assert main(["data", "inspect", str(out), "--sheet", str(sheet), "--each", "2"]) == 0
    assert "sheet.png: 6 parts by instance (left) and by kind (right)" in capsys.readouterr().out
    with Image.open(sheet) as picture:
        assert picture.width == 12 + 5 * 312 and picture.height == 44 + 2 * 182


def test_the_config_that_comes_along_is_the_default():
    assert settings.from_mapping(BuildConfig, settings.read_yaml(CONFIG), source=CONFIG) == BuildConfig()


def test_the_standard_set_trains_on_no_family_that_any_set_tests_on():
    config = settings.from_mapping(BuildConfig, settings.read_yaml(STANDARD), source=STANDARD)
    assert (config.train, config.val, config.test, config.max_mb) == (5000, 500, 1000, None)
    random = {"random_solid", "aligned_solid", "random_profile"}
    assert set(config.families.train) == {*families.STANDARD_TRAIN} | random
    assert config.families.val == families.STANDARD_VALIDATION and config.families.test == families.STANDARD_TEST
    assert sum(name in random for name in config.families.train) == 12


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["convert", "somewhere", "x.h5"], "data: somewhere does not exist: check the name."),
        (["inspect", "absent.h5"], "absent.h5"),
        (["inspect", "absent.h5", "--each", "0"], "--each 0 cannot be; give 1 or more."),
        (["build", "--out", "x.h5", "trian=3"], "did you mean 'train'"),
        (["build", "--out", "x.h5", "--workers", "0"], "--workers 0 cannot be; give 1 or more."),
        (["build", "--config", "absent.yaml", "--out", "x.h5"], "absent.yaml"),
    ],
)
def test_refusals_are_one_sentence(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["data", *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and message in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_words_are_needed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["data"])
    assert stop.value.code == 2 and "usage: jprimfit data" in capsys.readouterr().err
