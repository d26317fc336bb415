"""Overlap measures against values worked out by hand on clouds of ten points."""

import numpy as np
import pytest

from jprimfit.data.fit4cad import BenchmarkCloud
from jprimfit.evaluation.overlap import score


def cloud(members, kinds, surfaces, num_points=10):
    """A benchmark cloud of which only the segments matter."""
    rows = tuple(np.array(member, int) for member in members)
    radii = np.array([2.0 if kind == "cylinder" else np.nan for kind in kinds])
    return BenchmarkCloud("PC001", np.zeros((num_points, 3)), rows, tuple(kinds), np.array(surfaces), radii)


def scored(truth, labels, surface_of, kinds, radii=None):
    return score(truth, np.array(labels, np.int32), np.array(surface_of, np.int32), tuple(kinds), radii)


TWO = cloud([range(0, 6), range(6, 10)], ["plane", "cylinder"], [0, 1])


def test_a_perfect_answer_scores_one_whatever_its_numbers():
    found = scored(TWO, [1] * 6 + [0] * 4, [0, 1], ["cylinder", "plane"])
    assert found[:6] == (1, 1, 1, 1, 1, 1)
    assert np.isnan(found.left_of_others) and found.unassigned == 0
    assert (found.num_surfaces, found.num_predicted) == (2, 2)


def test_dice_and_iou_of_a_border_drawn_wrong():
    # Plane {0..5}, cylinder {6..9}; found {0..3} and {4..8}, 9 is left.
    found = scored(TWO, [0, 0, 0, 0, 1, 1, 1, 1, 1, -1], [0, 1], ["plane", "cylinder"])
    dice = 2 * 4 / (6 + 4), 2 * 3 / (4 + 5)
    iou = 4 / 6, 3 / 6
    assert found.dsc_instances == found.dsc_single == found.dsc_surfaces == pytest.approx(np.mean(dice))
    assert found.miou_surfaces == pytest.approx(np.mean(iou))
    assert found.unassigned == pytest.approx(0.1)
    # Only the plane is matched with an IoU of more than one half.
    assert found.kind_accuracy == 1
    assert scored(TWO, [0, 0, 0, 0, 1, 1, 1, 1, 1, -1], [0, 1], ["cone", "cylinder"]).kind_accuracy == 0


def test_one_prediction_may_serve_two_segments_in_dice_but_not_in_iou():
    found = scored(TWO, [0] * 10, [0], ["plane"])
    assert found.dsc_surfaces == pytest.approx((12 / 16 + 8 / 14) / 2)
    assert found.miou_surfaces == pytest.approx((6 / 10 + 0) / 2)
    assert found.num_predicted == 1


def test_dice_takes_the_segment_that_shares_most_points_not_the_best_ratio():
    truth = cloud([range(0, 5)], ["plane"], [0])
    # {0, 1, 2, 5..9} shares three points: 6/13; {3, 4} shares two: 4/7, which would be more.
    found = scored(truth, [0, 0, 0, 1, 1, 0, 0, 0, 0, 0], [0, 1], ["plane", "plane"])
    assert found.dsc_instances == pytest.approx(6 / 13)
    # In the IoU the rows 5..9, which no true segment lists, are left out.
    assert found.miou_surfaces == pytest.approx(3 / 5)


def test_points_that_several_segments_list():
    # Row 4 lies on the edge of both planes.
    truth = cloud([range(0, 5), range(4, 8)], ["plane", "plane"], [0, 1], num_points=8)
    found = scored(truth, [0] * 5 + [1] * 3, [0, 1], ["plane", "plane"])
    assert found.dsc_instances == found.dsc_surfaces == pytest.approx((1 + 2 * 3 / (4 + 3)) / 2)
    assert found.dsc_single == found.miou_surfaces == 1


def test_faces_of_one_surface_are_united_on_both_sides():
    # The truth lists one cylinder as two halves, the answer found it as one face, or cut it elsewhere.
    truth = cloud([range(0, 3), range(3, 6), range(6, 10)], ["cylinder", "cylinder", "plane"], [7, 7, 9])
    whole = scored(truth, [0] * 6 + [1] * 4, [0, 1], ["cylinder", "plane"])
    assert whole.dsc_instances == pytest.approx((2 * 3 / 9 + 2 * 3 / 9 + 1) / 3)
    assert whole.dsc_surfaces == whole.miou_surfaces == whole.kind_accuracy == 1
    cut = scored(truth, [0] * 2 + [2] * 4 + [1] * 4, [1, 0, 1], ["cylinder", "plane", "cylinder"])
    assert cut.dsc_surfaces == cut.miou_surfaces == cut.kind_accuracy == 1
    assert (cut.num_surfaces, cut.num_predicted) == (2, 2)
    assert cut.dsc_instances == pytest.approx((2 * 2 / 5 + 2 * 3 / 7 + 1) / 3)


def test_tori_are_scored_apart_and_best_left_alone():
    truth = cloud([range(0, 4), range(4, 8), range(8, 10)], ["plane", "torus", "other"], [0, 1, 2])
    left = scored(truth, [0] * 4 + [-1] * 6, [0], ["plane"])
    assert left.dsc_surfaces == left.miou_surfaces == left.left_of_others == 1
    assert left.dsc_surfaces_all == pytest.approx(1 / 3)
    taken = scored(truth, [0] * 6 + [-1] * 4, [0], ["plane"])
    assert taken.dsc_surfaces == pytest.approx(2 * 4 / (4 + 6))
    assert taken.miou_surfaces == pytest.approx(4 / 6)
    assert taken.left_of_others == pytest.approx(4 / 6)
    assert taken.num_surfaces == 3


def test_nothing_found_scores_zero():
    found = scored(TWO, [-1] * 10, [], [])
    assert (found.dsc_instances, found.dsc_surfaces, found.miou_surfaces, found.unassigned) == (0, 0, 0, 1)
    assert np.isnan(found.kind_accuracy) and found.num_predicted <= 1


def test_only_tori_leave_nothing_to_score_for_the_four_kinds():
    truth = cloud([range(0, 10)], ["torus"], [0])
    found = scored(truth, [-1] * 10, [], [])
    assert np.isnan([found.dsc_surfaces, found.miou_surfaces, found.kind_accuracy]).all()
    assert found.left_of_others == 1


def test_radii_of_matched_cylinders_of_the_right_kind():
    right = [0] * 6 + [1] * 4
    found = scored(TWO, right, [0, 1], ["plane", "cylinder"], np.array([np.nan, 2.02]))
    assert found.radius_error == pytest.approx(0.01)
    assert np.isnan(scored(TWO, right, [0, 1], ["plane", "sphere"], np.array([np.nan, 2.02])).radius_error)
    assert np.isnan(scored(TWO, [0] * 9 + [1], [0, 1], ["plane", "cylinder"], np.array([np.nan, 2.0])).radius_error)


def test_the_ceiling_is_the_score_of_the_true_labels():
    assert scored(TWO, [-1] * 10, [], []).ceiling == 1
    # Rows 4 and 5 lie on the edge; the smaller surface has them: 2 * 4 / (4 + 6) for the plane.
    edge = cloud([range(0, 6), range(4, 9)], ["plane", "cylinder"], [0, 1])
    labels = [0] * 4 + [1] * 5 + [-1]
    found = scored(edge, labels, [0, 1], ["plane", "cylinder"])
    assert found.ceiling == found.dsc_surfaces == pytest.approx((8 / 10 + 1) / 2)
