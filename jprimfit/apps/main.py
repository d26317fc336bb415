"""The command `jprimfit`: finds the word asked for and runs the file of that name in apps/.

Such a file offers `add_arguments(parser)` and `run(arguments) -> exit code`, and imports what is heavy inside run, so
that --help answers at once. Whatever is wrong with the input arrives here as a ValueError of one sentence and leaves as
that sentence on stderr and exit code 2.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence
from importlib.util import find_spec

from jprimfit import __version__

SUMMARIES = {
    "fit": "scans in, primitives, surfaces and a picture out",
    "demo": "fit the bundled scan and show the truth beside the answer",
    "view": "look at a scene in the browser",
    "assemble": "combine the surfaces of a scene into a solid",
    "data": "build, convert and inspect datasets",
    "train": "train a network",
    "evaluate": "score segmentations against the truth of a benchmark",
}
EXAMPLES = """examples:
  jprimfit demo
  jprimfit fit scan.ply --out out/scan
  jprimfit fit scans/*.xyz --out out --filter on
  jprimfit COMMAND --help
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command line (without the program's name) and returns its exit code: 0 done, 2 refused, 130 stopped."""
    argv = list(sys.argv[1:] if argv is None else argv)
    word = next((word for word in argv if not word.startswith("-")), None)
    built = [name for name in SUMMARIES if find_spec(f"jprimfit.apps.{name}")]
    if word is not None and word not in built:
        state = "is not built yet" if word in SUMMARIES else "is no command of jprimfit"
        return _refused(f"'{word}' {state}: use one of {', '.join(built)}.")
    arguments = _parser(built, word).parse_args(argv)
    try:
        return arguments.run(arguments)
    except ValueError as error:
        return _refused(f"{word}: {error}")
    except OSError as error:
        named = f"{error.filename}: " if error.filename else ""
        return _refused(f"{word}: {named}{error.strerror or error}; choose another place or make room there.")
    except MemoryError:
        return _refused(f"{word}: there is not enough memory for this scan; thin it out.")
    except KeyboardInterrupt:
        print("jprimfit: stopped, nothing is half written.", file=sys.stderr)
        return 130


def _parser(built: Sequence[str], word: str | None) -> argparse.ArgumentParser:
    """The parser of all words; only the one that is used gets its options, which takes importing its file."""
    parser = argparse.ArgumentParser(
        prog="jprimfit",
        description="From a scanned point cloud of a mechanical part to planes, spheres, cylinders and cones.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jprimfit {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in built:
        if name != word:
            commands.add_parser(name, help=SUMMARIES[name])
            continue
        module = importlib.import_module(f"jprimfit.apps.{name}")
        command = commands.add_parser(
            name,
            help=SUMMARIES[name],
            description=SUMMARIES[name],
            epilog=getattr(module, "EXAMPLES", None),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


def _refused(sentence: str) -> int:
    print("jprimfit: " + " ".join(sentence.split()), file=sys.stderr)
    return 2
