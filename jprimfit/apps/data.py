"""`jprimfit data`: builds data sets of random parts with exact labels, and shows what a data set holds."""

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

EXAMPLES = """examples:
  jprimfit data build --config configs/data/solids.yaml --out out/solids.h5
  jprimfit data build --out out/few.h5 train=200 val=20 test=20 seed=7
  jprimfit data inspect out/solids.h5
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    words = parser.add_subparsers(dest="word", metavar="WORD", required=True)
    build = words.add_parser("build", help="random solids with exact labels into one file")
    build.add_argument("--config", type=Path, metavar="FILE", help="YAML settings (default: those of data/build.py)")
    build.add_argument("--out", type=Path, required=True, metavar="FILE", help="the HDF5 file to write")
    build.add_argument("--workers", type=int, metavar="N", help="processes (default: one per CPU)")
    build.add_argument("settings", nargs="*", metavar="key=value", help="overrides, such as train=100")
    inspect = words.add_parser("inspect", help="counts per split, family, kind and number of instances")
    inspect.add_argument("file", type=Path, metavar="FILE", help="a data set")
    convert = words.add_parser("convert", help=argparse.SUPPRESS)
    convert.add_argument("rest", nargs=argparse.REMAINDER)


def run(arguments: argparse.Namespace) -> int:
    """Does what the word asks for; ValueError for whatever is wrong with the input."""
    if arguments.word == "build":
        return _build(arguments)
    if arguments.word == "inspect":
        return _inspect(arguments.file)
    raise ValueError("'convert' is not built yet: use build or inspect.")


def _build(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from jprimfit import settings
    from jprimfit.data.build import BuildConfig, build, total

    mapping = settings.read_yaml(arguments.config) if arguments.config else {}
    mapping = settings.with_overrides(mapping, arguments.settings)
    config = settings.from_mapping(BuildConfig, mapping, source=arguments.config or "the command line")
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f"--workers {arguments.workers} cannot be; give 1 or more.")
    begin = time.perf_counter()
    with tqdm(total=total(config), unit="part", mininterval=0.5) as bar:
        redrawn = build(arguments.out, config, workers=arguments.workers, progress=bar.update)
    seconds, size = time.perf_counter() - begin, arguments.out.stat().st_size
    print(
        f"{arguments.out}: {total(config)} parts, {size / 1e6:.1f} MB, {seconds:.1f} s "
        f"({total(config) / seconds:.1f} parts/s), {redrawn.total()} draws redrawn"
    )
    return 0


def _inspect(path: Path) -> int:
    from jprimfit.data.native import Dataset
    from jprimfit.data.records import KINDS

    with Dataset(path) as dataset:
        kinds = dataset.instances.kind.tolist()
        starts = dataset.starts.get("instance", [0] * (len(dataset) + 1))
        print(f"{path}: {len(dataset)} parts, {len(kinds)} instances")
        for name, value in dataset.info.items():
            print(f"  {name} = {value}")
        for split, rows in dataset.splits.items():
            counts = [int(starts[row + 1] - starts[row]) for row in rows]
            found = Counter(kind for row in rows for kind in kinds[starts[row] : starts[row + 1]])
            print(f"\n{split}: {len(rows)} parts, {_spread(counts)} instances each")
            shares = (
                f"{name} {100 * found[number] / max(1, found.total()):.1f} %" for number, name in enumerate(KINDS)
            )
            print("  " + ", ".join(shares))
            _print_families(dataset, rows, counts)
            bands = Counter(min(count // 5, 8) for count in counts)
            print("  instances " + ", ".join(f"{_band(band)}: {bands[band]}" for band in sorted(bands)))
    return 0


def _print_families(dataset: Any, rows: Any, counts: list[int]) -> None:
    """A line for every family of a split: how many parts, how many instances."""
    by_family: dict[str, list[int]] = {}
    for row, count in zip(rows, counts, strict=True):
        by_family.setdefault(dataset.families[row] or "(no family)", []).append(count)
    for family, members in sorted(by_family.items()):
        print(f"  {family:20s} {len(members):6d} parts, {_spread(members)} instances")


def _spread(counts: list[int]) -> str:
    return f"{sum(counts) / len(counts):.1f} ({min(counts)} to {max(counts)})"


def _band(band: int) -> str:
    return f"{5 * band}-{5 * band + 4}" if band < 8 else "40 or more"
