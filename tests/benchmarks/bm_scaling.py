"""Time and peak memory by number of points, beside Efficient RANSAC, on the same clouds in the same run.

python tests/benchmarks/bm_scaling.py [--points 1000 ... 1000000] [--part cross_yoke:0 ...] [--repeats 1] [--geometry]
Clouds are drawn at random on the exact surfaces of generated parts, family:seed, with Gaussian noise in per cent of the
diagonal. Each size runs in fresh processes, one per method, all parts in turn, each on clouds of its own. Seconds are
the median over parts and repeats: of jprimfit.fit warm, that is, a call that had to compile or load programs is made
again (nothing else is remembered from one to the next); of CGAL, PCA normals and detection with the tuned settings,
without handing over the points one by one in Python. Over 200,000 points a second call on the first part must do, less
its seconds of compilation; growth is that of the first part's seconds at all sizes. Programs are kept on disk from one
size to the next, as the command `jprimfit fit` keeps them, so that only the first row has a first call without any.
Peaks are resident memory (Linux), libraries included, the largest over the parts; CGAL's is of the process that
detects, which also holds the points as Python's numbers. DSC and surfaces say what the answers are worth.
"""

import argparse
import importlib.util
import os
import re
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jprimfit.data import surfaces
from jprimfit.data.families import FAMILIES
from jprimfit.data.fit4cad import BenchmarkCloud
from jprimfit.data.instances import is_same, make_part
from jprimfit.data.noise import perturb, sigma_of_percent
from jprimfit.evaluation.answers import of_scene
from jprimfit.evaluation.overlap import score
from jprimfit.evaluation.ransac import NOT_INSTALLED, Detector

POINTS = (1_000, 3_000, 10_000, 30_000, 131_072, 300_000, 1_000_000)
PARTS = ("cross_yoke:0", "crank:1", "valve_body:1")  # of test families; 21, 19 and 30 instances
MIN_SHARE = 0.002  # of the area: smaller faces are background
LARGE = 200_000  # clouds of more points are of one part and timed once
ASKED = 131_072  # points at which the two are compared in words
LEAST = 10_000  # points from which on the growth is measured
COLUMNS = (
    "points | fit s | first call s | geometry alone s | peak MB | DSC | surfaces | "
    "CGAL s | peak MB | DSC | surfaces | fit / CGAL"
)


class Measured(NamedTuple):
    """What one method did with all clouds of one size."""

    seconds: list[float]  # of each timed call
    peak: float  # MB
    answers: list  # of the last draw of each part
    first: float = np.nan  # seconds of the very first call
    processor: float = np.nan  # seconds of all cores, median
    again: int = 0  # timed calls that were made again, since programs had to be compiled or loaded
    geometry: tuple[float, ...] = ()  # seconds without the network
    stages: tuple[tuple[str, float], ...] = ()  # mean seconds of each stage in a timed call


def say(*words):
    """A line on the terminal."""
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def peak_mb():
    """The largest resident memory of this process so far; ru_maxrss would start from that of its parent."""
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024


def truth_of(part, points, labels):
    """The labels as segments for overlap.score; instances on one geometric surface share a number."""
    numbers, firsts = [], []
    for primitive in part.primitives:
        same = [number for number, first in enumerate(firsts) if is_same(first, primitive)]
        if not same:
            firsts.append(primitive)
        numbers.append(same[0] if same else len(firsts) - 1)
    members = tuple(np.flatnonzero(labels == label) for label in range(len(part.primitives)))
    there = [label for label, rows in enumerate(members) if len(rows)]
    return BenchmarkCloud(
        name=part.name,
        points=points,
        members=tuple(members[label] for label in there),
        kinds=tuple(part.primitives[label].kind for label in there),
        surfaces=np.array(numbers)[there],
        radii=np.full(len(there), np.nan),
    )


def draws(parts, folder, *, num_points, repeats, noise):
    """Files of noisy points, repeats + 1 per part, the first only to warm up on, and the truth of the last of each."""
    files, truths = [], []
    for number, part in enumerate(parts):
        files.append([])
        for draw in range(repeats + 1):
            cloud = surfaces.draw(part, num_points=num_points, seed=(number, draw, num_points), num_samples=0)
            generator = np.random.default_rng((number, draw))
            sigma = sigma_of_percent(cloud.points, noise)
            points = perturb(generator, cloud.points, cloud.normals, kind="gaussian", amount=sigma)
            files[-1].append(folder / f"{num_points}-{number}-{draw}.npy")
            np.save(files[-1][-1], points)
        truths.append(truth_of(part, points, cloud.labels))
    return files, truths


class Call(NamedTuple):
    """One call of jprimfit.fit."""

    scene: object
    seconds: float
    processor: float  # seconds of all cores
    stages: list[tuple[str, float]]


def call_fit(file, **options):
    """jprimfit.fit on the points of a file, timed stage by stage."""
    import jprimfit

    points, marks = np.load(file), []
    processor, begin = time.process_time(), time.perf_counter()
    scene = jprimfit.fit(points, progress=lambda stage, *_: marks.append((stage, time.perf_counter())), **options)
    end, processor = time.perf_counter(), time.process_time() - processor
    after = [mark for _, mark in marks[1:]] + [end]
    stages = [("start", marks[0][1] - begin)]
    stages += [(stage, then - mark) for (stage, mark), then in zip(marks, after, strict=True)]
    return Call(scene, end - begin, processor, stages)


def measure_fit(files, kept, geometry, once):
    """jprimfit.fit on the clouds of one size, then, if asked, without the network; programs are kept in a folder."""
    import jax

    from jprimfit import programs

    made_ready = []  # seconds of each program that was compiled, 0 for one that was loaded

    def compiled(event, seconds, **_):
        if event.endswith("backend_compile_duration"):
            made_ready.append(seconds)

    def loaded(file, load=programs._loaded):
        program = load(file)
        made_ready.extend([0.0] * (program is not None))
        return program

    jax.monitoring.register_event_duration_secs_listener(compiled)
    programs._loaded = loaded
    programs.keep_in(kept)
    first = call_fit(files[0][0]).seconds

    def warm(file, **options):
        """The call, made again where it had to wait for programs; once: only less the seconds of compilation."""
        made_ready.clear()
        call = call_fit(file, **options)
        again = bool(made_ready) and not once
        call = call._replace(seconds=call.seconds - sum(made_ready))
        return call_fit(file, **options) if again else call, again

    stages, answers, calls, again = defaultdict(float), [], [], 0
    for _, *others in files:
        for file in others:
            call, repeated = warm(file)
            calls.append(call._replace(scene=None))
            again += repeated
        answers.append(of_scene(call.scene))
    peak = peak_mb()
    for stage, seconds in (pair for call in calls for pair in call.stages):
        stages[stage] += seconds / len(calls)
    return Measured(
        seconds=[call.seconds for call in calls],
        peak=peak,
        answers=answers,
        first=first,
        processor=float(np.median([call.processor for call in calls])),
        again=again,
        geometry=tuple(warm(some[-1], model=None)[0].seconds for some in files if geometry),
        stages=tuple(stages.items()),
    )


def measure_cgal(files):
    """Efficient RANSAC on the same clouds."""
    seconds, answers = [], []
    with Detector(complain=say) as detect:
        for _, *others in files:
            for file in others:
                found = detect(np.load(file))
                seconds.append(found.seconds)
            answers.append(of_scene(found))
        peak = np.nan if detect._pool is None else detect._pool.submit(peak_mb).result()
    return Measured(seconds, peak, answers)


def alone(function, *given):
    """The function's answer, from a process of its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *given).result()


def worth(truths, measured):
    """Mean DSC over the true surfaces, the mean of it over the parts, and surfaces found and true, of all parts."""
    pairs = zip(truths, measured.answers, strict=True)
    scores = [score(truth, answer.labels, answer.surface_of, answer.kinds) for truth, answer in pairs]
    found, true = sum(s.num_predicted for s in scores), sum(s.num_surfaces for s in scores)
    return f"{np.mean([s.dsc_surfaces for s in scores]):.3f} | {found}/{true}"


def growth(points, seconds):
    """The exponent of the number of points in the time, by least squares from LEAST points on."""
    used = np.array(points) >= LEAST
    if np.sum(used) < 2 or not np.all(np.isfinite(np.array(seconds)[used])):
        return np.nan
    return np.polyfit(np.log(np.array(points)[used]), np.log(np.array(seconds)[used]), 1)[0]


def made(word):
    """The part that family:seed names."""
    family, seed = word.split(":")
    solid = FAMILIES[family](np.random.default_rng(int(seed)))
    part = make_part(getattr(solid, "solid", solid), min_share=MIN_SHARE, name=word)
    if part is None:
        raise ValueError(f"{word} gives no part: take another seed.")
    return part


def line(num_points, fit, cgal, truths):
    """A row of the table, and what it does not say: stages, spread, compilation."""
    ours, theirs = np.median(fit.seconds), np.median(cgal.seconds) if cgal else np.nan
    beside = f"{theirs:.2f} | {cgal.peak:.0f} | {worth(truths, cgal)}" if cgal else "- | - | - | -"
    alone_s = f"{np.median(fit.geometry):.2f}" if fit.geometry else "-"
    row = (
        f"| {num_points:,} | {ours:.2f} | {fit.first:.1f} | {alone_s} | {fit.peak:.0f} | "
        f"{worth(truths, fit)} | {beside} | {ours / theirs:.2f} |"
    )
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in fit.stages)
    spread = f"calls {min(fit.seconds):.2f} to {max(fit.seconds):.2f} s"
    spread += f", CGAL's {min(cgal.seconds):.2f} to {max(cgal.seconds):.2f} s" if cgal else ""
    spread += f"; {fit.processor:.2f} s of processor; {fit.again} of {len(fit.seconds)} calls made again"
    return row, f"{num_points:,}: {stages}; {spread}"


def main():
    """Measures and prints a row per size, then what they say together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=POINTS)
    parser.add_argument("--part", nargs="+", default=PARTS)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--noise", type=float, default=0.1)
    parser.add_argument("--geometry", action="store_true", help="time jprimfit.fit without the network, too")
    arguments = parser.parse_args()
    parts = [made(word) for word in arguments.part]
    with_cgal = importlib.util.find_spec("CGAL") is not None
    cores = len(os.sched_getaffinity(0))
    say(f"{', '.join(arguments.part)}; noise {arguments.noise} % of the diagonal; {cores} cores\n")
    if not with_cgal:
        say(NOT_INSTALLED)
    say(f"| {COLUMNS} |\n|{'---:|' * (COLUMNS.count('|') + 1)}")
    ours, theirs, notes, ratio = [], [], [], np.nan
    with tempfile.TemporaryDirectory() as kept:
        for num_points in arguments.points:
            large = num_points > LARGE
            repeats, some = (1, parts[:1]) if large else (arguments.repeats, parts)
            with tempfile.TemporaryDirectory() as folder:
                settings = {"num_points": num_points, "repeats": repeats, "noise": arguments.noise}
                files, truths = draws(some, Path(folder), **settings)
                fit = alone(measure_fit, files, Path(kept), arguments.geometry, large)
                cgal = alone(measure_cgal, files) if with_cgal else None
            ours.append(np.median(fit.seconds[:repeats]))
            theirs.append(np.median(cgal.seconds[:repeats]) if cgal else np.nan)
            if num_points == ASKED and cgal:
                ratio = np.median(fit.seconds) / np.median(cgal.seconds)
            row, note = line(num_points, fit, cgal, truths)
            say(row)
            notes.append(note)
    say("\n".join(["\nMean seconds of jprimfit.fit by stage, and how far the calls spread:", *notes]))
    exponents = growth(arguments.points, ours), growth(arguments.points, theirs)
    say("\nGrowth from {:,} points on: time ~ points^{:.2f}, CGAL's ~ points^{:.2f}".format(LEAST, *exponents))
    if ASKED in arguments.points:
        say(f"At {ASKED:,} points jprimfit.fit takes {ratio:.2f} times CGAL's time")


if __name__ == "__main__":
    main()
