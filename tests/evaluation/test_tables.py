"""Means, standard errors and tables of scores, against closed forms."""

import json

import numpy as np
import pytest

from jprimfit.evaluation import tables

NAN = float("nan")


def instance(kind="plane", share=0.5, **values):
    return {"kind": kind, "share": share, **dict.fromkeys(tables.INSTANCE_METRICS, 0.5), **values}


def part(*instances, **values):
    numbers = {**dict.fromkeys(tables.METRICS, 0.5), "seconds": 1.0}
    return {"name": "a part", "family": "a family", **numbers, **values, "instances": list(instances)}


def test_the_mean_over_parts_has_the_standard_error_of_independent_values():
    values = [0.2, 0.4, 0.9, 0.5]
    summary = tables.summarise([part(miou=value) for value in values])
    assert summary["mean"]["miou"] == pytest.approx(np.mean(values))
    assert summary["standard_error"]["miou"] == pytest.approx(np.std(values, ddof=1) / 2)


def test_what_was_not_there_to_score_counts_in_no_mean():
    summary = tables.summarise([part(axis_deg=NAN), part(axis_deg=2.0), part(axis_deg=4.0), part(axis_deg=np.inf)])
    assert summary["mean"]["axis_deg"] == 3.0 and summary["standard_error"]["axis_deg"] == pytest.approx(1.0)
    alone = tables.summarise([part(axis_deg=NAN, miou=0.25)])
    assert np.isnan(alone["mean"]["axis_deg"]) and alone["mean"]["miou"] == 0.25
    assert np.isnan(alone["standard_error"]["miou"])  # one part tells nothing of its spread


def test_groups_are_means_over_instances():
    first = part(instance(iou=1.0), instance("cone", 0.01, iou=0.0), instance("cone", 0.04, iou=0.5))
    second = part(instance("cone", 0.9, iou=0.9, axis_deg=NAN), instance("sphere", 0.05, iou=0.3))
    groups = tables.summarise([first, second])["groups"]
    assert {name: group["count"] for name, group in groups.items()} == {
        "plane": 1,
        "sphere": 1,
        "cylinder": 0,
        "cone": 3,
        "small": 2,
        "large": 3,
    }
    assert groups["cone"]["mean"]["miou"] == pytest.approx(1.4 / 3)
    assert groups["small"]["mean"]["miou"] == pytest.approx(0.25)
    assert groups["large"]["mean"]["miou"] == pytest.approx(2.2 / 3)
    assert np.isnan(groups["cylinder"]["mean"]["miou"])


def test_families_are_lines_with_the_means_of_every_method():
    bolts, nuts = [dict(part(miou=value), family="bolt") for value in (0.2, 0.4)], [dict(part(miou=0.9), family="nut")]
    better = [dict(score, miou=score["miou"] + 0.1, type_accuracy=1.0) for score in bolts + nuts]
    lines = tables.families_text({"one": bolts + nuts, "two": better}).splitlines()
    assert lines[0].split() == ["mIoU", "%", "/", "type", "%", "parts", "one", "two"]
    assert lines[2].split("  ")[0] == "bolt" and lines[2].split()[1] == "2"
    assert "30.0 ±10.0 / 50.0 ±0.0" in lines[2] and "40.0 ±10.0 / 100.0 ±0.0" in lines[2]
    assert lines[3].startswith("nut") and "90.0 / 50.0" in lines[3] and "100.0 / 100.0" in lines[3]


def test_instances_of_one_part_share_their_fate_in_the_standard_error():
    """Copies of an instance in the same part make the answer no surer, those in parts of their own do."""
    draw = np.random.default_rng(0)
    values = draw.random(40)
    alike = [part(*[instance(iou=value)] * 5) for value in values]
    apart = [part(instance(iou=value)) for value in values for _ in range(5)]
    error = np.std(values, ddof=1) / np.sqrt(40)
    assert tables.summarise(alike)["groups"]["plane"]["standard_error"]["miou"] == pytest.approx(error)
    assert tables.summarise(apart)["groups"]["plane"]["standard_error"]["miou"] < 0.5 * error


def test_the_printed_tables_are_in_per_cent_and_degrees():
    parts = [part(instance(iou=0.7, type_right=NAN), miou=m, normal_deg=7.0, residual=0.0021) for m in (0.5, 0.6)]
    summaries = {"one": tables.summarise(parts), "other": tables.summarise([part()])}
    lines = tables.overall_text(summaries).splitlines()
    assert lines[0].split()[:3] == ["method", "mIoU", "%"]
    assert "55.0 ±5.0" in lines[2] and "7.00 ±0.00" in lines[2] and "0.0021 ±0.0000" in lines[2]
    assert lines[3].startswith("other") and "50.0" in lines[3] and "±" not in lines[3]
    rows = tables.groups_text(summaries).splitlines()[2:]
    assert [row.split()[:2] for row in rows] == [["one", "planes"], ["one", "5"]]
    assert rows[0].split()[2:4] == ["2", "70.0"] and " -  " in rows[0]


def test_json_has_null_for_what_is_not_finite():
    value = {"a": [NAN, 1.0, (np.inf, "x", None, 3)], "b": {"c": True}}
    assert json.dumps(tables.without_nan(value), allow_nan=False) == (
        '{"a": [null, 1.0, [null, "x", null, 3]], "b": {"c": true}}'
    )
