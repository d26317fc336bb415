"""The ablation table: its variants are settings that share one pool, its runs are made once and seed by seed."""

import importlib.util
import json
from pathlib import Path

import pytest

from jprimfit import settings

SCRIPT = Path(__file__).parents[2] / "scripts" / "ablations.py"
SCORES = {"clouds": 4320, "parameters": 624857, "type_accuracy": 0.5, "normal_deg": 12.0}


@pytest.fixture(scope="module")
def ablations():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("ablations", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def runs(ablations, monkeypatch):
    """The names of the runs that were trained, in order; each takes no time and leaves its settings."""
    made = []

    def trained(config, folder):
        made.append(folder.name)
        folder.mkdir()
        (folder / "config.yaml").write_text(json.dumps(settings.to_mapping(config)), encoding="utf-8")
        return {**SCORES, "miou": 0.3 + 0.02 * config.seed}

    monkeypatch.setattr(ablations, "trained", trained)
    return made


def test_variants_differ_from_the_base_in_model_and_loss_only(ablations):
    base = ablations.settings_of("base")
    for name in ablations.VARIANTS:
        config = ablations.settings_of(name)
        changed = settings.differences(base, config)
        assert bool(changed) == (name != "base")
        assert all(key.startswith(("model.", "loss.")) for key in changed)
        # What a pool depends on.
        assert config.model.hierarchy == base.model.hierarchy
        assert config.model.neighborhoods == base.model.neighborhoods


def test_runs_are_made_seed_by_seed_and_not_twice(ablations, runs, tmp_path):
    table, steps = tmp_path / "table.md", {"base": 10, "slots": 12}
    assert ablations.run_all(tmp_path, steps, seeds=1, data=None, table=table)
    assert ablations.run_all(tmp_path, steps, seeds=2, data=None, table=table)
    assert runs == ["base-0", "slots-0", "base-1", "slots-1"]
    assert table.read_text(encoding="utf-8") == ablations.markdown(ablations.read_rows(tmp_path))


def test_finished_runs_of_other_settings_are_refused(ablations, runs, tmp_path):
    ablations.run_all(tmp_path, {"base": 10}, seeds=1, data=None, table=tmp_path / "table.md")
    with pytest.raises(ValueError, match=r"base-0 is a run with other settings of train\.steps"):
        ablations.run_all(tmp_path, {"base": 11}, seeds=1, data=None, table=tmp_path / "table.md")


def test_a_run_that_is_stopped_leaves_no_row(ablations, monkeypatch, tmp_path):
    monkeypatch.setattr(ablations, "trained", lambda config, folder: None)
    assert not ablations.run_all(tmp_path, {"base": 10}, seeds=1, data=None, table=tmp_path / "table.md")
    assert ablations.read_rows(tmp_path) == []


def test_the_budget_is_measured_once(ablations, monkeypatch, tmp_path):
    asked = []

    def measured(chosen):
        asked.extend(config.model.head for config in chosen)
        return [0.5 for _ in chosen]

    monkeypatch.setattr(ablations, "measured", measured)
    assert ablations.budget(tmp_path, ["base"], minutes=2, data=None) == {"base": 240}
    assert ablations.budget(tmp_path, ["base", "slots"], minutes=2, data=None) == {"base": 240, "slots": 240}
    assert asked == ["prototype", "slots"]
    with pytest.raises(ValueError, match="runs of 2 minutes"):
        ablations.budget(tmp_path, ["base"], minutes=3, data=None)


def test_the_table_has_means_and_deviations(ablations):
    rows = [{"variant": "base", "seed": seed, **SCORES, "miou": miou} for seed, miou in enumerate((0.3, 0.32))]
    rows.append({"variant": "slots", "seed": 0, **SCORES, "miou": 0.2})
    assert ablations.markdown(rows).splitlines() == [
        "| variant | clouds | parameters | mIoU % | types % | normals | seeds |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
        "| base | 4,320 | 624,857 | 31.0 ± 1.4 | 50.0 ± 0.0 | 12.0° ± 0.0 | 2 |",
        "| slots | 4,320 | 624,857 | 20.0 | 50.0 | 12.0° | 1 |",
    ]
