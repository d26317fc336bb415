"""The command `data`: a file and a line come out, counts are shown, refusals are one sentence."""

import re
from pathlib import Path

import pytest

from jprimfit import settings
from jprimfit.apps.main import main
from jprimfit.data.build import BuildConfig

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "data" / "solids.yaml"


def test_a_small_set_is_built_and_inspected(tmp_path, capsys):
    out = tmp_path / "few.h5"
    words = ["data", "build", "--config", str(CONFIG), "--out", str(out), "--workers", "1"]
    assert main([*words, "train=21", "val=2", "test=2", "seed=4"]) == 0
    printed = capsys.readouterr()
    assert re.search(r"few\.h5: 25 parts, \d\.\d MB, .* parts/s", printed.out) and "25/25" in printed.err
    assert main(["data", "inspect", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "25 parts" in shown and "seed = 4" in shown
    for words in ("train: 21 parts", "val: 2 parts", "test: 2 parts", "clevis", "hex_bolt"):
        assert words in shown
    shares = [float(share) for share in re.findall(r"(\d+\.\d) %", shown)]
    assert len(shares) == 12 and sum(shares) == pytest.approx(300, abs=1)


def test_the_config_that_comes_along_is_the_default():
    assert settings.from_mapping(BuildConfig, settings.read_yaml(CONFIG), source=CONFIG) == BuildConfig()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["convert", "somewhere"], "data: 'convert' is not built yet: use build or inspect."),
        (["inspect", "absent.h5"], "absent.h5"),
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
