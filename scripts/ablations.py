"""Trains the variants of an ablation table at equal budget, and writes the table in Markdown.

python scripts/ablations.py [--data FILE] [--workdir DIR] [--seeds 3] [--minutes 3] [--variants A,B] [--table FILE]
Each (variant, seed) is one training of configs/ablations.yaml, WORKDIR/VARIANT-SEED, scored on the validation clouds by
its weights of the last step. The budget is processor time of updates on ONE core, to which the script confines itself:
a step of every variant (a batch drawn, one update) is measured first, in turns, and as many steps as fit into
--minutes are made by all its seeds, under a cosine that ends there. Compiling and validating are not counted, nor is
what other programs on that core take; train.time_limit_minutes, which counts all of that, is left alone.
WORKDIR/budget.json holds those steps, results.json a row for each finished run, which is not done again. A run that was
stopped goes on from its last checkpoint. Seeds come in the outer loop, so that the table is complete early.
"""

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jprimfit.apps.cache import use_compilation_cache
from jprimfit.apps.memory import reuse_memory
from jprimfit.io.files import replacing
from jprimfit.networks import weights
from jprimfit.networks.segmenter import Segmenter
from jprimfit.settings import read_yaml
from jprimfit.training import config as configs
from jprimfit.training import loop, parallel, state, workdir, writer
from jprimfit.training.config import Config
from jprimfit.training.sources import open_sources
from jprimfit.training.step import CLOUD, Batch, initial_variables, train_step

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "ablations.yaml"
VARIANTS: dict[str, tuple[str, ...]] = {
    "base": (),
    # One judgement for each segment, from its largest features, instead of one for each point.
    "pooled-types": ("model.types=pooled",),
    # What is computed of a cloud before the network: filtered and PCA normals, as inputs, in the kernels of the
    # convolutions and below the normals. The steps of docs/preprocessing.md (outlier filter, smoothing) act on scans,
    # before recognition; the clouds of a training never go through them, and all have 2,048 points.
    "no-preprocessing": ("model.features=[xyz]", "model.pointconv.kernel=position", "model.normals=free"),
    "no-density": ("model.pointconv.density=false",),
    # Its columns are matched to the instances; the terms of the prototype head do not concern it.
    "slots": ("model.head=slots", "loss.miou=1"),
    "pointnet2": ("model.backbone=pointnet2",),
}
WARM, ROUNDS, STEPS = 2, 4, 5  # steps before measuring; turns of all variants, and measured steps in each
HEADER = ("variant", "clouds", "parameters", "mIoU %", "types %", "normals", "seeds")


def settings_of(variant: str, *, data: Path | None = None, seed: int = 0, steps: int | None = None) -> Config:
    """The settings of one run, as train.py would read them."""
    overrides = [*VARIANTS[variant], f"seed={seed}"]
    if data is not None:
        overrides.append(f"data.file={json.dumps(str(data))}")
    if steps is not None:
        overrides.append(f"train.steps={steps}")
    return configs.read(CONFIG, overrides)


def measured(chosen: Sequence[Config]) -> list[float]:
    """Median seconds of processor time of one step of each."""
    runs = [_steps(config) for config in chosen]
    spent: list[list[float]] = [[] for _ in runs]
    for run in runs:
        run(WARM)
    for _ in range(ROUNDS):
        for run, seconds in zip(runs, spent, strict=True):
            seconds += run(STEPS)
    jax.clear_caches()
    return [statistics.median(seconds) for seconds in spent]


def _steps(config: Config) -> Callable[[int], list[float]]:
    """The function that makes some more steps of a training and tells the processor time of each."""
    training = open_sources(config).training
    size = config.train.batch_size
    cloud = jax.tree.map(lambda x: x[0], training.batch(0, 1))
    variables = initial_variables(Segmenter(config.model), cloud, config=config)
    segmenter = Segmenter(config.model, axis_names=(CLOUD, parallel.AXIS))
    step = train_step(segmenter, config=config, num_steps=configs.num_steps(config.train, training.num_clouds))
    devices = parallel.parallelise(step, kind=config.train.parallel, num_devices=1)
    present, made = devices.replicate(state.create(variables, config=config.optimizer)), 0

    def run(count: int) -> list[float]:
        nonlocal present, made
        seconds = []
        for _ in range(count):
            begin = time.process_time()
            batch = Batch(training.batch(made, size), np.arange(size, dtype=np.int32))
            present, metrics = devices.step(present, devices.shard(batch))
            jax.block_until_ready((present, metrics))
            seconds.append(time.process_time() - begin)
            made += 1
        return seconds

    return run


def budget(folder: Path, variants: Sequence[str], *, minutes: float, data: Path | None) -> dict[str, int]:
    """Steps of each variant: those that the folder knows, and for the others what is measured now and written there."""
    path = folder / "budget.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"minutes": minutes, "variants": {}}
    if known["minutes"] != minutes:
        raise ValueError(
            f"{folder} holds runs of {known['minutes']:g} minutes: ask for these, or give another --workdir."
        )
    new = [name for name in variants if name not in known["variants"]]
    for name, seconds in zip(new, measured([settings_of(name, data=data) for name in new]), strict=True):
        steps = max(1, round(60 * minutes / seconds))
        known["variants"][name] = {"seconds_per_step": round(seconds, 4), "steps": steps}
        _say(f"{name}: {1000 * seconds:.0f} ms a step, {steps} steps")
    _write(path, known)
    return {name: known["variants"][name]["steps"] for name in variants}


def trained(config: Config, folder: Path) -> dict[str, Any] | None:
    """What one run came to, trained in its folder, or from where it stopped; None if a signal stops it."""
    begin = time.process_time()
    outcome = loop.train(config, folder)
    if outcome.signal is not None:
        return None
    scores = [line for line in writer.read(folder) if line["kind"] == "validation"][-1]
    parameters = jax.tree.leaves(weights.load(folder / workdir.LAST).variables["params"])
    return {
        "steps": outcome.step,
        "clouds": outcome.step * config.train.batch_size,
        "parameters": sum(x.size for x in parameters),
        **{name: value for name, value in scores.items() if name not in ("step", "kind")},
        "processor_minutes": round((time.process_time() - begin) / 60, 2),  # of this call, compiling included
    }


def run_all(folder: Path, steps: dict[str, int], *, seeds: int, data: Path | None, table: Path) -> bool:
    """Makes all runs that are missing, seed by seed, and the table after each; False if a signal stops them."""
    path = folder / "results.json"
    for seed in range(seeds):
        for name in steps:
            config, place = settings_of(name, data=data, seed=seed, steps=steps[name]), folder / f"{name}-{seed}"
            rows = read_rows(folder)
            if any((row["variant"], row["seed"]) == (name, seed) for row in rows):
                changed = configs.forbidden_changes(read_yaml(place / workdir.SETTINGS), config)
                if changed:
                    raise ValueError(
                        f"{place} is a run with other settings of {', '.join(changed)}: give another --workdir."
                    )
                continue
            found = trained(config, place)
            if found is None:
                return False
            _write(path, [*rows, {"variant": name, "seed": seed, **found}])
            with replacing(table) as file:
                file.write(markdown(read_rows(folder)).encode())
            jax.clear_caches()
    return True


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The finished runs of a workdir."""
    path = folder / "results.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else []


def markdown(rows: Iterable[dict[str, Any]]) -> str:
    """The table: mean ± standard deviation over the seeds, a line for each variant that has a run."""
    lines = [HEADER, ("---",) + ("---:",) * (len(HEADER) - 1)]
    rows = list(rows)
    for name in VARIANTS:
        runs = [row for row in rows if row["variant"] == name]
        if runs:
            lines.append(
                (
                    name,
                    f"{runs[0]['clouds']:,}",
                    f"{runs[0]['parameters']:,}",
                    _spread([100 * run["miou"] for run in runs]),
                    _spread([100 * run["type_accuracy"] for run in runs]),
                    _spread([run["normal_deg"] for run in runs], unit="°"),
                    str(len(runs)),
                )
            )
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _spread(values: list[float], *, unit: str = "") -> str:
    deviation = f" ± {statistics.stdev(values):.1f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.1f}{unit}{deviation}"


def _write(path: Path, value: Any) -> None:
    with replacing(path) as file:
        file.write(json.dumps(value, indent=1).encode())


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _on_one_core() -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def _names(text: str) -> list[str]:
    names = [name for name in VARIANTS if name in text.split(",")]
    unknown = set(text.split(",")) - set(names)
    if unknown:
        raise argparse.ArgumentTypeError(f"{', '.join(sorted(unknown))} is none of {', '.join(VARIANTS)}")
    return names


def main() -> int:
    """Measures, trains, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, metavar="FILE", help="the dataset (default out/standard.h5)")
    parser.add_argument("--workdir", type=Path, default=Path("runs/ablations"), metavar="DIR")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="runs of every variant")
    parser.add_argument(
        "--minutes", type=float, default=3, metavar="M", help="of processor time for the steps of a run"
    )
    parser.add_argument("--variants", type=_names, default=list(VARIANTS), metavar="A,B", help=", ".join(VARIANTS))
    parser.add_argument("--table", type=Path, metavar="FILE", help="default WORKDIR/table.md")
    arguments = parser.parse_args()
    _on_one_core()
    reuse_memory()
    use_compilation_cache()
    folder = arguments.workdir
    folder.mkdir(parents=True, exist_ok=True)
    try:
        steps = budget(folder, arguments.variants, minutes=arguments.minutes, data=arguments.data)
        table = arguments.table or folder / "table.md"
        complete = run_all(folder, steps, seeds=arguments.seeds, data=arguments.data, table=table)
    except (ValueError, loop.NotFinite) as error:
        _say(f"ablations: {error}")
        return 2
    print(markdown(read_rows(folder)), end="")
    return 0 if complete else 1


if __name__ == "__main__":
    raise SystemExit(main())
