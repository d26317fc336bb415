"""`jprimfit fit`: one scan or several in, for each a folder with the scene, coloured points, surfaces and a picture.

Tables go to stdout, progress and complaints to stderr. Of several scans each has a folder of its own under --out; a
scan that cannot be used is named in one sentence, the others go on, and the exit code is 2.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jprimfit.networks.weights import Model
    from jprimfit.scene import Scene

EXAMPLES = """examples:
  jprimfit fit scan.ply --out out/scan            one scan, files in out/scan
  jprimfit fit a.xyz b.stl c.npz --out out        several, files in out/a, out/b, out/c
  jprimfit fit noisy.ply --out out --filter on    remove outliers whether or not there seem to be any
  jprimfit fit scan.ply --out out --tolerance 0.05 --min-points 50 --kinds plane,cylinder
  jprimfit fit scan.ply --labels out/scan/scene.json --merge 3,7 --retype 5=cone --out out/better
                                                  corrected by hand: segments stay, their surfaces are fitted anew

formats:
  PLY, XYZ/CSV/TXT/ASC/PTS, NPY/NPZ, OBJ, STL; with pip install 'jprimfit[formats]' also PCD, LAS/LAZ, E57.
  A mesh is sampled at 65,536 points. Any unit, any position; the answer is in those of the scan.

files in DIR:
  scene.json + scene.npz   everything, for jprimfit.Scene.load     segments.ply     points coloured by primitive
  features.csv             size, extent, position and +- of each   deviations.ply   points coloured by deviation
  surfaces.obj + .mtl      the trimmed surfaces                    report.png       scan, segments and surfaces
  surfaces.step            the same for CAD, with pip install 'jprimfit[cad]'
"""


# A scan of a room can hold hundreds; scene.json lists all of them.
MAX_ROWS = 40


class Outcome(NamedTuple):
    """One scan of a batch: the scene, or the sentence that says why there is none."""

    scan: Path
    folder: Path
    scene: "Scene | None"
    seconds: float
    failure: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT", help="scan file")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument(
        "--filter", choices=["auto", "on", "off"], default="auto", help="remove outliers (auto: if there are any)"
    )
    parser.add_argument("--smooth", choices=["on", "off"], default="off", help="smooth what the segmentation sees")
    network = parser.add_mutually_exclusive_group()
    network.add_argument("--no-network", action="store_true", help="by geometry alone: region growing")
    network.add_argument("--model", metavar="NAME", help="network, by name or folder (default: default)")
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="LENGTH",
        help="how far the scan may lie from its surfaces, in its unit (default: three times the noise, estimated)",
    )
    parser.add_argument("--min-points", type=int, default=6, metavar="N", help="of a face (default 6)")
    parser.add_argument("--kinds", metavar="KIND,...", help="kinds that are looked for (default: all four)")
    corrected = parser.add_argument_group("segments corrected by hand (of one scan)")
    corrected.add_argument(
        "--labels", type=Path, metavar="FILE", help="segment of each point: scene.json, PLY, NPY, text"
    )
    corrected.add_argument("--merge", action="append", default=[], metavar="A,B", help="segments that are one")
    corrected.add_argument("--retype", action="append", default=[], metavar="A=KIND", help="the kind of a segment")
    parser.add_argument("--device", choices=["cpu", "gpu"], help="default: a GPU where JAX finds one")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of all random choices (default 0)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but complaints")


def run(arguments: argparse.Namespace) -> int:
    """Fits every scan and prints the tables; 0 if all went well, 2 if one was refused."""
    from jprimfit.apps.outputs import check_target

    check_target(arguments.out)
    _choose_device(arguments.device)
    say = _silent if arguments.quiet else _progress
    arguments.model = _model(arguments)
    arguments.narrowed = _narrowed(arguments)
    if len(arguments.inputs) == 1:
        outcome = fit_file(arguments.inputs[0], arguments.out, arguments, say=say)
        if not arguments.quiet:
            print(answer_text(outcome))
        return 0
    outcomes = []
    for number, (scan, folder) in enumerate(
        zip(arguments.inputs, _folders(arguments.inputs, arguments.out), strict=True)
    ):
        say(f"scan {number + 1} of {len(arguments.inputs)}")
        try:
            check_target(folder)
            outcomes.append(fit_file(scan, folder, arguments, say=say))
        except ValueError as error:
            failure = " ".join(str(error).split())
            print(f"jprimfit: fit: {failure}", file=sys.stderr)
            outcomes.append(Outcome(scan, folder, None, 0.0, failure))
    if not arguments.quiet:
        print(summary_text(outcomes))
    return 2 if any(outcome.scene is None for outcome in outcomes) else 0


def fit_file(scan: Path, folder: Path, options: argparse.Namespace, *, say: Callable[[str], None]) -> Outcome:
    """Reads a scan, fits it and writes the files of the answer; ValueError of one sentence that names the scan.

    options: model as in pipeline.fit, seed, filter and smooth as in the command's arguments, and in narrowed further
    words of pipeline.fit.
    """
    begin = time.perf_counter()
    from jprimfit.apps.cache import use_programs
    from jprimfit.apps.outputs import write_outputs
    from jprimfit.io.clouds import read_cloud

    cloud = read_cloud(scan)
    say(f"{scan}: {len(cloud.points):,} point{'s' if len(cloud.points) != 1 else ''}")
    if not use_programs():
        say(f"{scan}: compiling, which is kept for later scans")
    from jprimfit import pipeline

    narrowed = options.narrowed
    if cloud.tolerance is not None and "tolerance" not in narrowed:
        say(f"{scan}: its facets lie up to {cloud.tolerance:.3g} off round walls, which is taken for the --tolerance")
        narrowed = {**narrowed, "tolerance": cloud.tolerance}
    try:
        scene = pipeline.fit(
            cloud.points,
            cloud.normals,
            model=options.model,
            seed=options.seed,
            filter=options.filter,
            smooth=options.smooth == "on",
            progress=_stages(scan, say),
            **narrowed,
        )
    except ValueError as error:
        raise ValueError(f"{scan}: {error}") from error
    say(f"{scan}: {_kinds_text(scene)} after {time.perf_counter() - begin:.1f} s, writing {folder}")
    for note in write_outputs(scene, folder, title=scan.name):
        say(f"{scan}: {note}")
    return Outcome(scan, folder, scene, time.perf_counter() - begin, "")


def _choose_device(device: str | None) -> None:
    """Before JAX is loaded; a GPU's memory is taken as it is needed, not most of it at once."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if device is None:
        return
    import jax

    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[device])
    try:
        jax.devices()
    except RuntimeError:
        raise ValueError(
            "--device gpu: JAX finds no GPU here; leave the option out, or install jprimfit[cuda]."
        ) from None


def _narrowed(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the user asks of pipeline.fit beyond the default."""
    found: dict[str, Any] = {"min_points": arguments.min_points}
    if arguments.tolerance is not None:
        found["tolerance"] = arguments.tolerance
    if arguments.kinds is not None:
        found["kinds"] = [kind.strip() for kind in arguments.kinds.split(",")]
    if arguments.labels is None:
        if arguments.merge or arguments.retype:
            raise ValueError("--merge and --retype change segments: name them with --labels, such as out/scene.json.")
        return found
    if len(arguments.inputs) > 1:
        raise ValueError(f"--labels are those of one scan, and {len(arguments.inputs)} are given: fit them one by one.")
    from jprimfit.apps import labels

    found["labels"] = labels.merged(labels.read_labels(arguments.labels), arguments.merge)
    found["kind_of"] = labels.retyped(arguments.retype)
    return found


def _model(arguments: argparse.Namespace) -> "str | Model | None":
    """What pipeline.fit is given; a model in a folder is read here, once for all scans and before the first of them."""
    if arguments.no_network:
        return None
    if arguments.model is None:
        return "default"
    from jprimfit.networks import weights

    return weights.load(arguments.model)


def answer_text(outcome: Outcome) -> str:
    """The table of the primitives, how much of the scan they explain, and where the files are."""
    import numpy as np

    scene = outcome.scene
    assert scene is not None
    if not scene.primitives:
        lines = [f"no primitives found in {len(scene.points):,} points", *_left_out(scene.report)]
        return "\n".join([*lines, f"wrote {outcome.folder} in {outcome.seconds:.1f} s"])
    explained = np.mean(scene.labels >= 0)
    lines = [
        scene.table(max_rows=MAX_ROWS),
        "",
        f"{_kinds_text(scene)}, on which {100 * explained:.1f} % of {len(scene.points):,} points lie",
    ]
    if np.isfinite(scene.noise):
        lines[-1] += f", noise {scene.noise:.3g}"
    lines += _left_out(scene.report)
    return "\n".join([*lines, f"wrote {outcome.folder} in {outcome.seconds:.1f} s"])


def _left_out(report: Mapping[str, Any]) -> list[str]:
    """A line on the points that no primitive was sought for, if there are any."""
    counts = {
        "not finite": report.get("num_unusable", 0),
        "removed as outliers (see --filter)": report.get("preprocessing", {}).get("num_removed", 0),
    }
    parts = [f"{count:,} {why}" for why, count in counts.items() if count]
    return [f"points left out: {', '.join(parts)}"] if parts else []


def summary_text(outcomes: Sequence[Outcome]) -> str:
    """One line per scan of a batch."""
    import numpy as np

    from jprimfit.io.text_table import text_table

    rows = []
    for outcome in outcomes:
        scene = outcome.scene
        if scene is None:
            rows.append([str(outcome.scan), "", "", "", "", f"failed: {outcome.failure}"])
            continue
        explained = f"{100 * np.mean(scene.labels >= 0):.1f} %"
        measured = [f"{len(scene.points):,}", explained, f"{outcome.seconds:.1f}"]
        rows.append([str(outcome.scan), *measured, _kinds_text(scene), str(outcome.folder)])
    return text_table(["scan", "points", "explained", "seconds", "primitives", "result"], rows)


def _kinds_text(scene: "Scene") -> str:
    kinds = [primitive.kind for primitive in scene.primitives]
    parts = [f"{kinds.count(k)} {k}{'s' if kinds.count(k) > 1 else ''}" for k in dict.fromkeys(sorted(kinds))]
    return ", ".join(parts) or "no primitives"


def _folders(scans: Sequence[Path], out: Path) -> list[Path]:
    """A folder per scan, by its stem; one that came before, upper and lower case being equal, gets a number."""
    taken: set[str] = set()
    folders = []
    for scan in scans:
        stem = scan.stem or "scan"
        name, number = stem, 1
        while name.lower() in taken:
            number += 1
            name = f"{stem}-{number}"
        taken.add(name.lower())
        folders.append(out / name)
    return folders


def _stages(scan: Path, say: Callable[[str], None]) -> Callable[[str, int, int], None]:
    """A progress callback (stage, steps done, steps in all) that says each stage once, when it begins."""
    said: set[str] = set()

    def report(stage: str, done: int, total: int) -> None:
        if stage not in said:
            said.add(stage)
            say(f"{scan}: {stage}")

    return report


def _progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _silent(line: str) -> None:
    """Takes the place of `_progress` under --quiet."""
