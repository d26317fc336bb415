"""Overlap of a segmentation with a benchmark whose segments are point sets that may share points.

B is a true segment, P a predicted one, both sets of the n points. DSC = 2|B∩P| / (|B| + |P|), each B taking the P with
which it shares most points; not one to one, as the Fit4CAD benchmark defines it (Romanengo et al. 2021). The mean over
B is the score of a cloud, the mean over clouds that of a method. Readings of it: instances (the benchmark's own),
single (instances, over the points that exactly one of them lists), surfaces (faces of one geometric surface united on
both sides: no scan can tell two half cylinders apart). Beside them the one-to-one mean IoU over surfaces, over the
points of exactly one, the share of matched surfaces whose kind is right, and the errors of their radii. Since a point
gets one label and those on edges have several, nobody reaches 1: `ceiling` is what the true labels reach.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_matrix

from jprimfit.data.fit4cad import BenchmarkCloud
from jprimfit.primitives.table import KINDS


class Overlap(NamedTuple):
    """Scores of one cloud, fractions in [0, 1]; NaN where nothing was there to score."""

    dsc_instances: float  # the benchmark's DSC
    dsc_single: float  # DSC1
    dsc_surfaces: float  # merged surfaces of plane, sphere, cylinder and cone
    dsc_surfaces_all: float  # DSCs: merged surfaces of every kind
    miou_surfaces: float  # one-to-one (Hungarian) IoU over merged surfaces of the four kinds, shared points left out
    kind_accuracy: float  # of the merged surfaces of the four kinds that are matched with IoU > 0.5
    radius_error: float  # median |r - true| / true of cylinders and spheres matched with IoU > 0.5 in the right kind
    ceiling: float  # dsc_surfaces of the true labels, points on edges in the smallest surface that lists them
    left_of_others: float  # share of the points of tori and free forms that were left at -1
    unassigned: float  # share of all points left at -1
    num_surfaces: int  # true merged surfaces
    num_predicted: int  # predicted merged surfaces


def score(
    cloud: BenchmarkCloud,
    labels: np.ndarray,
    surface_of: np.ndarray,
    kinds: tuple[str, ...],
    radii: np.ndarray | None = None,
) -> Overlap:
    """Scores labels (n,) int, -1 = none, with surface_of (p,), the kind and the radius of each of the p primitives."""
    num_points = len(cloud.points)
    members, surfaces, surface_kinds, true_radii = list(cloud.members), *_merge_surfaces(cloud)
    faces = _membership(labels, len(kinds))
    merged_labels = np.where(labels >= 0, np.append(surface_of, 0)[labels], -1)
    merged = _membership(merged_labels, int(surface_of.max(initial=-1)) + 1)
    ours = np.array([kind in KINDS for kind in surface_kinds], dtype=bool)

    times_listed = np.bincount(np.concatenate(members), minlength=num_points)
    single = times_listed == 1
    true_sets, true_instances = _rows(surfaces, num_points), _rows(members, num_points)
    dsc_surfaces = _dice(true_sets, merged)
    others = np.unique(
        np.concatenate([s for s, own in zip(surfaces, ours, strict=True) if not own] or [np.zeros(0, int)])
    )
    iou, partner = _one_to_one(true_sets, merged)
    matched = np.flatnonzero(ours & (iou > 0.5))
    kind_of = {int(surface): kind for surface, kind in zip(surface_of, kinds, strict=True)}
    right = np.array([surface_kinds[i] == kind_of.get(int(partner[i])) for i in matched], bool)
    found_radii = np.full(merged.shape[0], np.nan)
    if radii is not None:
        found_radii[surface_of] = radii
    exact = matched[right]
    errors = np.abs(found_radii[partner[exact]] / true_radii[exact] - 1)
    errors = errors[np.isfinite(errors)]
    return Overlap(
        dsc_instances=_mean(_dice(true_instances, faces)),
        dsc_single=_mean(_dice(_keep(true_instances, single), _keep(faces, single))),
        dsc_surfaces=_mean(dsc_surfaces[ours]),
        dsc_surfaces_all=_mean(dsc_surfaces),
        miou_surfaces=_mean(iou[ours]),
        kind_accuracy=_mean(right),
        radius_error=float(np.median(errors)) if len(errors) else float("nan"),
        ceiling=_mean(_dice(true_sets, _membership(_one_label(surfaces, num_points), len(surfaces)))[ours]),
        left_of_others=_mean(labels[others] < 0),
        unassigned=_mean(labels < 0),
        num_surfaces=len(surfaces),
        num_predicted=merged.shape[0],
    )


def _merge_surfaces(cloud: BenchmarkCloud) -> tuple[list[np.ndarray], list[str], np.ndarray]:
    """Unites the instances of one surface: per surface its rows, its kind and its radius."""
    sets, kinds, radii = [], [], []
    for surface in np.unique(cloud.surfaces):
        instances = np.flatnonzero(cloud.surfaces == surface)
        sets.append(np.unique(np.concatenate([cloud.members[i] for i in instances])))
        kinds.append(cloud.kinds[instances[0]])
        radii.append(cloud.radii[instances[0]])
    return sets, kinds, np.array(radii)


def _one_label(sets: list[np.ndarray], num_points: int) -> np.ndarray:
    """For every point the smallest set that lists it, -1 where none does."""
    labels = np.full(num_points, -1)
    for number in sorted(range(len(sets)), key=lambda row: -len(sets[row])):
        labels[sets[number]] = number
    return labels


def _rows(sets: list[np.ndarray], num_points: int) -> csr_matrix:
    bounds = np.concatenate([[0], np.cumsum([len(s) for s in sets])])
    columns = np.concatenate(sets)
    return csr_matrix((np.ones(len(columns)), columns, bounds), shape=(len(sets), num_points))


def _membership(labels: np.ndarray, num: int) -> csr_matrix:
    rows = np.flatnonzero(labels >= 0)
    return csr_matrix((np.ones(len(rows)), (labels[rows], rows)), shape=(max(num, 1), len(labels)))


def _keep(sets: csr_matrix, mask: np.ndarray) -> csr_matrix:
    return sets[:, np.flatnonzero(mask)]


def _dice(true_sets: csr_matrix, predicted: csr_matrix) -> np.ndarray:
    """DSC of every non-empty true set with the predicted set it shares most points with; NaN for an empty one."""
    common = (true_sets @ predicted.T).toarray()
    best = common.argmax(axis=1)
    size_true, size_predicted = _sizes(true_sets), _sizes(predicted)
    dice = 2 * common[np.arange(len(best)), best] / np.maximum(size_true + size_predicted[best], 1)
    return np.where(size_true > 0, dice, np.nan)


def _one_to_one(true_sets: csr_matrix, predicted: csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """IoU of every true set with the predicted one it is paired with, and which that is (-1 = none, IoU 0).

    Over the points that exactly one true set lists.
    """
    single = np.asarray(true_sets.sum(axis=0)).ravel() == 1
    true_sets, predicted = _keep(true_sets, single), _keep(predicted, single)
    common = (true_sets @ predicted.T).toarray()
    iou = common / np.maximum(_sizes(true_sets)[:, None] + _sizes(predicted)[None, :] - common, 1)
    best, partner = np.zeros(len(iou)), np.full(len(iou), -1)
    rows, columns = linear_sum_assignment(-iou)
    best[rows], partner[rows] = iou[rows, columns], columns
    return best, partner


def _sizes(sets: csr_matrix) -> np.ndarray:
    return np.asarray(sets.sum(axis=1)).ravel()


def _mean(values: np.ndarray) -> float:
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")
