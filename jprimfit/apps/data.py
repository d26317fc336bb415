"""`jprimfit data`: builds data sets of random parts with exact labels, makes them from files of others, shows them."""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

EXAMPLES = """examples:
  jprimfit data build --config configs/data/solids.yaml --out out/solids.h5
  jprimfit data build --out out/few.h5 train=200 val=20 test=20 seed=7
  jprimfit data build --config configs/data/standard.yaml --out out/standard.h5 max_mb=40
  jprimfit data inspect out/standard.h5 --sheet out/standard.png
  jprimfit data convert parts/ out/parts.h5                        STEP files, a family per folder
  jprimfit data convert out/parts.h5 out/traceparts --points 8192  a file per part, for SPFN and CPFN
"""
CONVERT_EXAMPLES = """examples:
  jprimfit data convert part.step out/part.h5                  every solid of a STEP file a part
  jprimfit data convert parts/ out/parts.h5 --split train      all STEP files below a folder, a family per folder
  jprimfit data convert out/parts.h5 out/traceparts            8,192 points of each part, 512 of each instance
  jprimfit data convert traceparts/ out/traceparts.h5          the published files, splits by their csv lists
  jprimfit data convert data/shapes/test_data.h5 out/test.h5   ParSeNet or HPNet: clouds, parameters fitted

What INPUT is is told by its content. What cannot be used is named on stderr and left out; the exit code is 0 if
anything was converted. STEP needs pip install 'jprimfit[cad]'. More: docs/data-convert.md.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    words = parser.add_subparsers(dest="word", metavar="WORD", required=True)
    build = words.add_parser("build", help="random solids with exact labels into one file")
    build.add_argument("--config", type=Path, metavar="FILE", help="YAML settings (default: those of data/build.py)")
    build.add_argument("--out", type=Path, required=True, metavar="FILE", help="the HDF5 file to write")
    build.add_argument("--workers", type=int, metavar="N", help="processes (default: one per CPU)")
    build.add_argument("settings", nargs="*", metavar="key=value", help="overrides, such as train=100")
    inspect = words.add_parser("inspect", help="counts and areas per split, family and kind; a contact sheet")
    inspect.add_argument("file", type=Path, metavar="FILE", help="a data set")
    inspect.add_argument("--sheet", type=Path, metavar="PNG", help="a picture of the first parts of every family")
    inspect.add_argument("--each", type=int, default=1, metavar="N", help="parts of a family on the sheet (default 1)")
    _add_convert(words)


def _add_convert(words: Any) -> None:
    convert = words.add_parser(
        "convert",
        help="STEP, TraceParts, ParSeNet, HPNet into one file, or TraceParts from it",
        description="Parts from files of several formats into one data set, or into TraceParts files.",
        epilog=CONVERT_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    convert.add_argument("input", type=Path, metavar="INPUT", help="a file, or a folder with all below it")
    convert.add_argument("output", type=Path, metavar="OUTPUT", help="HDF5 file; with --to traceparts a new folder")
    convert.add_argument(
        "--to",
        choices=["native", "traceparts"],
        help="what to write (default: traceparts from a native file, else native)",
    )
    convert.add_argument(
        "--split", metavar="NAME", help="of all parts (default: as in the input, test where it has none)"
    )
    convert.add_argument(
        "--points",
        type=int,
        metavar="N",
        help="drawn on parts that hold surfaces only (default: 8192 for traceparts, none for native)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Does what the word asks for; ValueError for whatever is wrong with the input."""
    if arguments.word == "build":
        return _build(arguments)
    if arguments.word == "inspect":
        return _inspect(arguments.file, arguments.sheet, arguments.each)
    return _convert(arguments)


def _build(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from jprimfit import settings
    from jprimfit.data.build import BuildConfig, build, total
    from jprimfit.data.native import Dataset

    mapping = settings.read_yaml(arguments.config) if arguments.config else {}
    mapping = settings.with_overrides(mapping, arguments.settings)
    config = settings.from_mapping(BuildConfig, mapping, source=arguments.config or "the command line")
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f"--workers {arguments.workers} cannot be; give 1 or more.")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    begin, made = time.perf_counter(), 0
    with tqdm(total=total(config), unit="part", mininterval=0.5) as bar:

        def progress(number: int) -> None:
            nonlocal made
            made += number
            bar.update(number)

        def planned(number: int, found: int) -> None:
            bar.total, bar.n, bar.initial = number, found, found - made
            bar.refresh()

        redrawn = build(arguments.out, config, workers=arguments.workers, progress=progress, planned=planned)
    seconds, size = time.perf_counter() - begin, arguments.out.stat().st_size
    with Dataset(arguments.out) as dataset:
        count = len(dataset)
    print(
        f"{arguments.out}: {count} parts, {size / 1e6:.1f} MB ({size / count / 1e3:.1f} kB a part), {seconds:.1f} s "
        f"({made / seconds:.1f} parts/s), {redrawn.total()} draws redrawn"
    )
    return 0


def _convert(arguments: argparse.Namespace) -> int:
    from contextlib import ExitStack

    from tqdm import tqdm

    from jprimfit.apps.cache import use_compilation_cache
    from jprimfit.data.convert import convert, inputs

    use_compilation_cache()
    begin = time.perf_counter()
    with ExitStack() as stack:
        found = inputs(arguments.input, stack, split=arguments.split)
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        to = arguments.to or ("traceparts" if found.is_native else "native")
        bar = stack.enter_context(tqdm(total=len(found.items), unit="input", mininterval=0.5))
        summary = convert(
            found.items,
            arguments.output,
            to=to,
            num_points=arguments.points,
            complain=lambda sentence: bar.write(f"jprimfit: data: {sentence}", file=sys.stderr),
            progress=bar.update,
        )
    seconds = time.perf_counter() - begin
    kinds = ", ".join(f"{kind} {number}" for kind, number in summary.kinds.items())
    print(
        f"{arguments.output}: {summary.num_parts} parts of {len(found.items) - summary.num_failed} inputs, "
        f"{summary.num_failed} left out, {_size(arguments.output) / 1e6:.1f} MB, {seconds:.1f} s; "
        f"{kinds}; {100 * summary.background:.1f} % background"
    )
    return 0


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return sum(file.stat().st_size for file in ([path] if path.is_file() else path.iterdir()))


def _inspect(path: Path, sheet: Path | None, each: int) -> int:
    from jprimfit.data.native import Dataset
    from jprimfit.data.records import KINDS

    if each < 1:
        raise ValueError(f"--each {each} cannot be; give 1 or more.")
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
            print("  of the instances: " + ", ".join(shares))
            print("  of the area of a part: " + ", ".join(_area_shares(dataset, rows)))
            _print_families(dataset, rows, counts)
            bands = Counter(min(count // 5, 8) for count in counts)
            print("  instances " + ", ".join(f"{_band(band)}: {bands[band]}" for band in sorted(bands)))
        if sheet is not None:
            _write_sheet(sheet, dataset, each)
    return 0


def _area_shares(dataset: Any, rows: Any) -> list[str]:
    """Of every kind and of the background the mean over parts of its share; areas that are not known count nothing."""
    import numpy as np

    from jprimfit.data.records import KINDS

    starts = dataset.starts.get("instance", [0] * (len(dataset) + 1))
    shares = np.zeros(len(KINDS) + 1)
    for row in rows:
        mine = slice(int(starts[row]), int(starts[row + 1]))
        area = np.bincount(dataset.instances.kind[mine], dataset.areas[mine], minlength=len(KINDS) + 1)
        area[-1] = dataset.background_areas[row]
        shares += area / max(float(np.sum(area)), 1e-300) / len(rows)
    return [f"{name} {100 * share:.1f} %" for name, share in zip((*KINDS, "other"), shares, strict=True)]


def _write_sheet(path: Path, dataset: Any, each: int) -> None:
    """The first parts of every family that have a triangulation, families in the order of the file."""
    from jprimfit.data.records import KINDS, pack
    from jprimfit.io.sheet import Cell, write_sheet

    members: dict[str, list[int]] = {}
    for row, family in enumerate(dataset.families):
        if len(members.setdefault(family, [])) < each:
            members[family].append(row)
    cells = []
    for row in (row for rows in members.values() for row in rows):
        part = dataset[row]
        if part.mesh is not None:
            longest = 2 * part.scale if part.unit else 0.0
            caption = f"{part.family or part.name}{f', {longest:,.4g} {part.unit}' if longest else ''}"
            cells.append(Cell(caption, *part.mesh, pack(part.primitives).kind))
    write_sheet(path, cells, kinds=KINDS, title=f"{dataset.path}: {len(members)} families")
    print(f"\n{path}: {len(cells)} parts by instance (left) and by kind (right)")


def _print_families(dataset: Any, rows: Any, counts: list[int]) -> None:
    """A line for every family of a split: how many parts, how many instances."""
    by_family: dict[str, list[int]] = {}
    for row, count in zip(rows, counts, strict=True):
        by_family.setdefault(dataset.families[row] or "(no family)", []).append(count)
    for family, members in sorted(by_family.items()):
        print(f"  {family:22s} {len(members):6d} parts, {_spread(members)} instances")


def _spread(counts: list[int]) -> str:
    return f"{sum(counts) / len(counts):.1f} ({min(counts)} to {max(counts)})"


def _band(band: int) -> str:
    return f"{5 * band}-{5 * band + 4}" if band < 8 else "40 or more"
