"""`jprimfit evaluate`: how well segmentations agree with the truth of a benchmark.

Built so far: --protocol fit4cad, the overlap measures of evaluation/overlap over a file of Fit4CAD clouds.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

EXAMPLES = """examples:
  jprimfit evaluate --data fit4cad.h5 --clouds 1-151
  jprimfit evaluate --data fit4cad.h5 --rotate --noise 1 --json scores.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    parser.add_argument("--protocol", choices=["fit4cad"], default="fit4cad", help="what is measured (default fit4cad)")
    parser.add_argument("--data", type=Path, required=True, metavar="FILE", help="HDF5 file of the benchmark's clouds")
    parser.add_argument(
        "--clouds", default="1-1000", metavar="A-B", help="clouds PCA to PCB, such as 1-151 (default all)"
    )
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th of them (default 1)")
    parser.add_argument(
        "--noise", type=float, default=0.0, metavar="P", help="Gaussian noise, sigma = P %% of the diagonal"
    )
    parser.add_argument("--rotate", action="store_true", help="turn every cloud at random (seeded)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the scores of every cloud as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Scores the clouds one after another, prints a line each and the means."""
    from jprimfit import pipeline
    from jprimfit.data.fit4cad import read_clouds
    from jprimfit.evaluation import overlap
    from jprimfit.io.files import replacing

    first, last = _range(arguments.clouds)
    if not 0 <= arguments.noise < np.inf or arguments.every < 1:
        raise ValueError(
            f"--noise {arguments.noise:g} --every {arguments.every} cannot be: "
            "give a noise of 0 or more and a step of 1 or more."
        )
    parts = []
    for cloud in list(read_clouds(arguments.data, first=first, last=last))[:: arguments.every]:
        cloud = _disturbed(cloud, noise=arguments.noise, rotate=arguments.rotate)
        begin = time.perf_counter()
        scene = pipeline.fit(cloud.points, model=None)
        seconds = time.perf_counter() - begin
        scored = overlap.score(cloud, scene.labels, scene.surface_of, tuple(p.kind for p in scene.primitives))
        parts.append({"name": cloud.name, "points": len(cloud.points), "seconds": seconds, **scored._asdict()})
        print(_line(cloud.name, parts[-1]), flush=True)
    if not parts:
        raise ValueError(f"{arguments.data} holds none of the clouds {arguments.clouds}: give another range.")
    mean = {key: _mean([part[key] for part in parts]) for key in parts[0] if key != "name"}
    print(_line(f"mean {len(parts)}", mean))
    if arguments.json:
        text = json.dumps(_without_nan({"mean": mean, "parts": parts}), indent=1, allow_nan=False)
        with replacing(arguments.json) as file:
            file.write(text.encode())
    return 0


def _mean(values: list) -> float:
    """Mean of what was there to score, NaN where nothing was."""
    scored = [value for value in values if not np.isnan(value)]
    return float(np.mean(scored)) if scored else float("nan")


def _without_nan(value: Any) -> Any:
    """The value with null for NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and np.isnan(value) else value


def _range(text: str) -> tuple[int, int]:
    try:
        first, last = text.split("-")
        return int(first), int(last)
    except ValueError:
        raise ValueError(f"--clouds {text!r} is no range; expected two numbers such as 1-151.") from None


def _disturbed(cloud, *, noise: float, rotate: bool):
    """The cloud under a random rotation and noise in per cent of its diagonal, seeded by its name."""
    generator = np.random.default_rng(list(cloud.name.encode()))
    points = cloud.points
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    if rotate:
        turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
        points = points @ (turn * np.sign(np.linalg.det(turn)))
    if noise > 0:
        points = points + generator.normal(size=points.shape) * diagonal * noise / 100
    return cloud._replace(points=points)


def _line(name: str, values: dict) -> str:
    return (
        f"{name:10s} {values['points']:8.0f} points {values['seconds']:6.1f} s   "
        f"DSC surfaces {values['dsc_surfaces']:.3f} all {values['dsc_surfaces_all']:.3f} "
        f"instances {values['dsc_instances']:.3f} single {values['dsc_single']:.3f}   "
        f"mIoU {values['miou_surfaces']:.3f} kind {values['kind_accuracy']:.3f}   "
        f"surfaces {values['num_predicted']:.0f}/{values['num_surfaces']:.0f} none {100 * values['unassigned']:.1f} %"
    )
