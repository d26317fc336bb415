"""`jprimfit evaluate`: how well segmentations agree with the truth of a data set or a benchmark.

--protocol six: the six metrics (evaluation/six) of a network's own answer, of the whole pipeline, of geometry alone and
of Efficient RANSAC, over the parts of one split. --protocol fit4cad: the overlap measures of evaluation/overlap over a
file of Fit4CAD clouds. Tables go to stdout, progress to stderr.
"""

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jprimfit.evaluation.ransac import Detector, Settings
    from jprimfit.networks.weights import Model

EXAMPLES = """examples:
  python evaluate.py                                       the shipped network on the test set, which is built once
  python evaluate.py --ckpt runs/small --parts 60          a training's network, on 60 parts
  python evaluate.py --compare --json scores.json          network, network with refinement, and geometry alone
  python evaluate.py --data parts.h5 --split val --noise 1
  python evaluate.py --protocol fit4cad --data fit4cad.h5 --clouds 1-151 --method geometry
  python evaluate.py --ckpt default runs/small --refine    two networks on the same clouds
  python evaluate.py --method ransac --refine              CGAL's Efficient RANSAC, its own fits and ours
  python evaluate.py --table 1 --data standard.h5          Table 1: both shipped networks, and all else
  python evaluate.py --table parameters --datasets 1000    single primitives against the bounds of statistics

what is measured (--protocol six), per part, then the mean over parts with its standard error:
  mIoU (of true surfaces with the found ones), type (share of right kinds), normal and axis (degrees),
  residual (distance of clean points to the found surface; the part is 2 long), P cover (points nearer than 0.01)
"""
METHODS = ("pointconv", "spfn", "geometry", "ransac")
NO_NETWORK = ("geometry", "ransac")
BLOCKS = ("whole", "part", "few-points", "coverage")
LATER = ("cpfn",)
BATCH = 8  # clouds that a network sees at once
MIN_POINTS = 128
WORDS = {
    "network": "network",
    "refined": "network + refinement",
    "geometry": "geometry alone",
    "ransac": "Efficient RANSAC",
    "refitted": "Efficient RANSAC + refit",
}
RANSAC_SETTINGS = ("default", "tuned", "noise-0.5", "noise-1")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    add = parser.add_argument
    add("--protocol", choices=["six", "fit4cad"], default="six", help="what is measured (default six)")
    add("--ckpt", nargs="+", metavar="DIR", help="networks: default, spfn, or folders of some (default: default)")
    add("--data", type=Path, metavar="FILE", help="data set, or the clouds of Fit4CAD (default: the test set)")
    add("--split", default="test", metavar="NAME", help="of the data set (default test)")
    add("--method", default="pointconv", metavar="NAME", help=f"{', '.join(METHODS)} (default pointconv)")
    add("--compare", action="store_true", help="the network, its refinement and geometry alone on the same clouds")
    add(
        "--refine",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="six: score the whole pipeline, too, as fit runs it; fit4cad: the whole pipeline (default) or, with "
        "--no-refine, the network's own answer; ransac: fit its segments again by ours",
    )
    add("--ransac", choices=RANSAC_SETTINGS, default="tuned", help="settings of --method ransac (default tuned)")
    add("--points", type=int, default=8192, metavar="N", help="points per cloud (default 8192)")
    add("--parts", type=int, metavar="N", help="at most so many parts or clouds (default all)")
    add("--every", type=int, default=1, metavar="N", help="take every N-th of them (default 1)")
    add("--noise", type=float, metavar="P", help="Gaussian, sigma = P %% of the diagonal (default: six uniform 0.01)")
    add("--clouds", default="1-1000", metavar="A-B", help="fit4cad: clouds PCA to PCB, such as 1-151 (default all)")
    add("--rotate", action="store_true", help="fit4cad: turn every cloud at random (seeded, as all that follows)")
    add("--thin", type=float, default=100.0, metavar="P", help="fit4cad: keep P %% of the points (default 100)")
    add("--outliers", type=float, default=0.0, metavar="P", help="fit4cad: add P %% of points in the box (default 0)")
    add("--json", type=Path, metavar="FILE", help="write the scores of every part as JSON")
    add("--table", choices=["parameters", "1", "timing"], help="a table of the paper; built: parameters, 1")
    add("--datasets", type=int, default=100, metavar="N", help="table parameters: data sets per cell (default 100)")
    add("--block", choices=BLOCKS, help="table parameters: only this block (default all)")
    add("--patch", metavar="WORDS", help="table parameters: only patches whose name holds these words (default all)")


def run(arguments: argparse.Namespace) -> int:
    """Scores what is asked for, prints tables and writes the JSON."""
    _check(arguments)
    from jprimfit.apps.cache import use_compilation_cache

    use_compilation_cache()
    if arguments.table == "parameters":
        scores = _parameters(arguments)
    else:
        scores = _fit4cad(arguments) if arguments.protocol == "fit4cad" else _six(arguments)
    if arguments.json:
        from jprimfit.evaluation.tables import without_nan
        from jprimfit.io.files import replacing

        text = json.dumps(without_nan(scores), indent=1, allow_nan=False)
        with replacing(arguments.json) as file:
            file.write(text.encode())
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuses what cannot be meant, before anything is computed."""
    if arguments.table == "timing":
        raise ValueError("--table timing is not built yet: use --table parameters, --table 1, or --compare.")
    if arguments.table == "1" and (arguments.protocol != "six" or arguments.method in NO_NETWORK):
        raise ValueError("--table 1 compares all methods by the six metrics: leave --protocol and --method out.")
    if arguments.protocol == "fit4cad" and len(arguments.ckpt or []) > 1:
        raise ValueError("--protocol fit4cad takes one network: give one --ckpt.")
    if arguments.method in LATER:
        raise ValueError(f"--method {arguments.method} is not built yet: use {' or '.join(METHODS)}, or --compare.")
    if arguments.datasets < 2:
        raise ValueError(f"--datasets {arguments.datasets} cannot be: give 2 or more, for a mean and its spread.")
    if arguments.method not in METHODS:
        raise ValueError(f"--method {arguments.method!r} is none; expected {', '.join(METHODS)}.")
    if arguments.noise is not None and not 0 <= arguments.noise < np.inf or arguments.every < 1:
        raise ValueError(
            f"--noise {arguments.noise} --every {arguments.every} cannot be: "
            "give a noise of 0 or more and a step of 1 or more."
        )
    if arguments.points < MIN_POINTS or (arguments.parts is not None and arguments.parts < 1):
        raise ValueError(
            f"--points {arguments.points} --parts {arguments.parts} cannot be: "
            f"give {MIN_POINTS} points or more and 1 part or more."
        )
    if arguments.method in NO_NETWORK and (arguments.ckpt or arguments.compare):
        raise ValueError(f"--method {arguments.method} takes no network: leave --ckpt and --compare out.")
    if arguments.method == "geometry" and arguments.refine is not None:
        raise ValueError("--method geometry has nothing to refine: leave --refine out.")
    if arguments.json and not arguments.json.absolute().parent.is_dir():
        raise ValueError(f"--json {arguments.json}: there is no folder {arguments.json.parent}; make it first.")
    if arguments.protocol == "six" and (arguments.rotate or arguments.thin != 100 or arguments.outliers):
        raise ValueError("--rotate, --thin and --outliers belong to --protocol fit4cad: leave them out.")
    if not 0 < arguments.thin <= 100 or not 0 <= arguments.outliers <= 1000:
        raise ValueError(
            f"--thin {arguments.thin:g} --outliers {arguments.outliers:g} cannot be: "
            "keep more than 0 and at most 100 %, and add 0 to 1000 %."
        )
    if arguments.protocol == "fit4cad" and arguments.data is None:
        raise ValueError("--protocol fit4cad needs --data FILE, the HDF5 file of the benchmark's clouds.")
    if arguments.data is not None and not arguments.data.is_file():
        raise ValueError(f"--data {arguments.data} is not a file; give a data set or leave it out.")


class Method(NamedTuple):
    """One row of the tables."""

    words: str
    answer: str  # a key of WORDS
    ckpt: str | None = None  # of the network, where there is one


def _networks(arguments: argparse.Namespace) -> list[str]:
    from jprimfit.networks.weights import SHIPPED

    if arguments.table == "1":
        return arguments.ckpt or list(SHIPPED)
    return arguments.ckpt or ["spfn" if arguments.method == "spfn" else "default"]


def _methods(arguments: argparse.Namespace) -> dict[str, Method]:
    """What is compared, by its name in the JSON."""
    others = {name: Method(WORDS[name], name) for name in ("geometry", "ransac", "refitted")}
    if arguments.method == "geometry":
        return {"geometry": others["geometry"]}
    if arguments.method == "ransac":
        return {name: others[name] for name in ("ransac", "refitted")[: 1 + bool(arguments.refine)]}
    answers = ["network"] + ["refined"] * bool(arguments.refine or arguments.compare or arguments.table)
    ckpts = _networks(arguments)
    chosen = {}
    for answer in answers:
        for ckpt in ckpts:
            one, words = answer, WORDS[answer]
            if len(ckpts) > 1:
                one, words = f"{ckpt} {answer}", words.replace("network", ckpt)
            chosen[one] = Method(words, answer, ckpt)
    beside = list(others) if arguments.table else ["geometry"] * arguments.compare
    return chosen | {name: others[name] for name in beside}


def _six(arguments: argparse.Namespace) -> dict[str, Any]:
    """The scores of every method on the same clouds: the first one's at the top, all of them under "methods"."""
    from jprimfit.data.native import Dataset
    from jprimfit.evaluation import six, tables
    from jprimfit.networks import weights

    chosen = _methods(arguments)
    models = {method.ckpt: weights.load(method.ckpt) for method in chosen.values() if method.ckpt}
    data = arguments.data or _test_set()
    with Dataset(data) as dataset, contextlib.ExitStack() as stack:
        numbers = six.parts_of(dataset, arguments.split, every=arguments.every, most=arguments.parts)
        # Hours of networks should not end in the news that CGAL is not installed.
        detector = _detector(arguments, stack) if "ransac" in chosen else None
        methods = {}
        for name, method in chosen.items():
            rows = _rows(method, dataset, numbers, models.get(method.ckpt or ""), detector, arguments)
            methods[name] = {**tables.summarise(rows), "parts": rows}
    shown = {chosen[name].words: scores for name, scores in methods.items()}
    print(tables.overall_text(shown), end="\n\n")
    print(tables.groups_text(shown), end="\n\n")
    print(tables.families_text({words: scores["parts"] for words, scores in shown.items()}), end="\n\n")
    noise = "uniform noise of 0.01" if arguments.noise is None else f"noise of {arguments.noise:g} % of the diagonal"
    print(
        f"{len(numbers)} parts of split {arguments.split} of {data}, {arguments.points:,} points each, {noise}; "
        "± standard error; s/part is the method's own time"
    )
    first = next(iter(methods))
    about = {
        "data": str(data),
        "split": arguments.split,
        "points": arguments.points,
        "noise_percent": arguments.noise,
        "ckpt": chosen[first].ckpt,
        "method": first,
    }
    return {**methods[first], **about, "methods": methods}


def _rows(
    method: Method,
    dataset: Any,
    numbers: Any,
    model: "Model | None",
    detector: "tuple[Settings, Detector] | None",
    arguments: argparse.Namespace,
) -> list[dict]:
    """The scores of one method on all parts, with a bar that shows the mean mIoU."""
    from tqdm import tqdm

    from jprimfit.evaluation import answers, six

    network = model.config if model is not None and method.answer == "network" else None
    found = six.cases(dataset, numbers, network=network, num_points=arguments.points, noise=arguments.noise)
    scores: Iterator[dict[str, Any]]
    if method.answer == "network":
        assert model is not None
        scores = six.network_scores(model, found, batch_size=min(BATCH, len(numbers)))
    elif method.answer in ("ransac", "refitted"):
        assert detector is not None
        settings, detect = detector
        answer = partial(answers.ransac_scene, detect, settings, refit=method.answer == "refitted")
        scores = six.scene_scores(found, answer)
    else:
        scores = six.scene_scores(found, six.pipeline_with(model))
    rows = []
    with tqdm(total=len(numbers), desc=method.words, unit="part", mininterval=0.5) as bar:
        for row in scores:
            rows.append(row)
            bar.set_postfix_str(f"mIoU {100 * np.mean([row['miou'] for row in rows]):.1f} %", refresh=False)
            bar.update(1)
    return rows


def _detector(arguments: argparse.Namespace, stack: contextlib.ExitStack) -> "tuple[Settings, Detector]":
    from jprimfit.evaluation import ransac

    detect = stack.enter_context(ransac.Detector(lambda sentence: print(f"jprimfit: {sentence}", file=sys.stderr)))
    return ransac.SETTINGS[arguments.ransac], detect


def _test_set() -> Path:
    """The file of the test set in the user's cache, built first if it is not there."""
    from tqdm import tqdm

    from jprimfit.apps.cache import cache_folder
    from jprimfit.evaluation import test_set

    folder = cache_folder() / "data"
    path = test_set.path_in(folder)
    if not path.is_file():
        count = test_set.CONFIG.test
        print(f"building the test set of {count} parts of unseen families, once, in {folder}", file=sys.stderr)
        with tqdm(total=count, unit="part", mininterval=0.5, file=sys.stderr) as bar:
            test_set.build_in(folder, progress=bar.update)
    return path


def _fit4cad(arguments: argparse.Namespace) -> dict[str, Any]:
    """Scores the clouds one after another, prints a line each and the means, of the errors of radii the median."""
    from jprimfit.data.fit4cad import read_clouds
    from jprimfit.evaluation import answers, disturbance, overlap
    from jprimfit.networks import weights

    first, last = _range(arguments.clouds)
    model = None if arguments.method in NO_NETWORK else weights.load(_networks(arguments)[0])
    changes = {
        "rotate": arguments.rotate,
        "noise": arguments.noise or 0.0,
        "thin": arguments.thin,
        "outliers": arguments.outliers,
    }
    parts = []
    clouds = list(read_clouds(arguments.data, first=first, last=last))[:: arguments.every]
    with contextlib.ExitStack() as stack:
        if arguments.method == "ransac":
            settings, detect = _detector(arguments, stack)
            answer = partial(answers.efficient_ransac, detect, settings, refit=bool(arguments.refine))
        elif model is not None and arguments.refine is False:
            answer = partial(answers.network_alone, model)
        else:
            answer = partial(answers.whole_pipeline, model)
        for cloud in clouds[: arguments.parts]:
            cloud = disturbance.disturbed(cloud, **changes)
            begin = time.perf_counter()
            found = answer(cloud.points)
            seconds = time.perf_counter() - begin
            scored = overlap.score(cloud, *found)
            parts.append({"name": cloud.name, "points": len(cloud.points), "seconds": seconds, **scored._asdict()})
            print(_line(cloud.name, parts[-1]), flush=True)
    if not parts:
        raise ValueError(f"{arguments.data} holds none of the clouds {arguments.clouds}: give another range.")
    mean = {key: _mean([part[key] for part in parts]) for key in parts[0] if key != "name"}
    known = [part["radius_error"] for part in parts if not np.isnan(part["radius_error"])]
    mean["radius_error"] = float(np.median(known)) if known else float("nan")
    print(_line(f"mean {len(parts)}", mean))
    return {"changes": changes, "mean": mean, "parts": parts}


def _parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """The paper's Tables 2-5 with bounds, and the blocks that they leave out."""
    from tqdm import tqdm

    from jprimfit.apps.cache import use_compilation_cache
    from jprimfit.evaluation import parameters

    chosen = [cell for cell in parameters.cells() if arguments.block in (None, cell.block.replace(" ", "-"))]
    names = dict.fromkeys(cell.patch.name for cell in chosen)
    chosen = [cell for cell in chosen if (arguments.patch or "") in cell.patch.name]
    if not chosen:
        raise ValueError(f"--patch {arguments.patch!r} is in no name of a patch; there are {'; '.join(names)}.")
    total = sum(parameters.count_of(cell, arguments.datasets) for cell in chosen)
    with tqdm(total=total, unit="data set", mininterval=0.5, file=sys.stderr) as bar:
        rows = parameters.run(chosen, arguments.datasets, initializer=use_compilation_cache, progress=bar.update)
    print(parameters.text(rows))
    return {"datasets": arguments.datasets, "cells": rows}


def _mean(values: list) -> float:
    """Mean of what was there to score, NaN where nothing was."""
    scored = [value for value in values if not np.isnan(value)]
    return float(np.mean(scored)) if scored else float("nan")


def _range(text: str) -> tuple[int, int]:
    try:
        first, last = text.split("-")
        return int(first), int(last)
    except ValueError:
        raise ValueError(f"--clouds {text!r} is no range; expected two numbers such as 1-151.") from None


def _line(name: str, values: dict) -> str:
    return (
        f"{name:10s} {values['points']:8.0f} points {values['seconds']:6.1f} s   "
        f"DSC surfaces {values['dsc_surfaces']:.3f} all {values['dsc_surfaces_all']:.3f} "
        f"instances {values['dsc_instances']:.3f} single {values['dsc_single']:.3f}   "
        f"of {values['ceiling']:.3f}   "
        f"mIoU {values['miou_surfaces']:.3f} kind {values['kind_accuracy']:.3f} radius {values['radius_error']:.1e}   "
        f"surfaces {values['num_predicted']:.0f}/{values['num_surfaces']:.0f} none {100 * values['unassigned']:.1f} %"
    )
