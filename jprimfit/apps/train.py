"""`jprimfit train`: trains a network by the settings of a file, and resumes by itself."""

import argparse
import signal
import sys
from pathlib import Path

EXAMPLES = """examples:
  python train.py --config configs/tiny.yaml
  python train.py --config configs/small.yaml --workdir runs/mine optimizer.learning_rate=3e-3 train.steps=20000
  python train.py --config configs/small.yaml --profile
  python train.py --config configs/paper.yaml --coordinator host0:1234 --num-processes 2 --process-id 0

A workdir that holds a run is resumed from its newest checkpoint, and refused if the settings differ. --fresh puts that
run aside (runs/NAME becomes runs/NAME.1). Ctrl-C and SIGTERM save before they end it.
"""
STOPPED = {signal.SIGINT: 130, signal.SIGTERM: 143}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options to a parser."""
    parser.add_argument(
        "--config", type=Path, required=True, metavar="FILE", help="settings, such as configs/tiny.yaml"
    )
    parser.add_argument("--workdir", type=Path, metavar="DIR", help="where all results go (default runs/NAME)")
    parser.add_argument("--fresh", action="store_true", help="begin anew; a run in the workdir is put aside")
    parser.add_argument("--profile", action="store_true", help="only print where the time of a step goes, part by part")
    parser.add_argument(
        "--coordinator", metavar="HOST:PORT", help="of process 0, or auto: several hosts train together"
    )
    parser.add_argument("--num-processes", type=int, metavar="N", help="of a run on several hosts")
    parser.add_argument("--process-id", type=int, metavar="I", help="of this process, 0 to N - 1")
    parser.add_argument("settings", nargs="*", metavar="key.sub=value", help="settings that replace those of the file")


def run(arguments: argparse.Namespace) -> int:
    """Trains, says how it ended and where the results lie."""
    from jprimfit.apps.cache import use_compilation_cache
    from jprimfit.apps.memory import reuse_memory

    reuse_memory()
    from jprimfit.training import config, loop, parallel

    use_compilation_cache()
    chosen = config.read(arguments.config, arguments.settings)
    if arguments.profile:
        from jprimfit.training import profile

        print(profile.text(profile.profile(chosen)))
        return 0
    folder = arguments.workdir or Path("runs") / arguments.config.stem
    if arguments.coordinator:
        parallel.initialise_distributed(arguments.coordinator, arguments.num_processes, arguments.process_id)
    elif arguments.num_processes is not None or arguments.process_id is not None:
        raise ValueError("--num-processes and --process-id need the --coordinator host:port of process 0.")
    try:
        outcome = loop.train(chosen, folder, fresh=arguments.fresh)
    except loop.NotFinite as error:
        raise ValueError(str(error)) from None
    if parallel.is_writer():
        score = "" if outcome.best is None else f", best validation mIoU {100 * outcome.best:.1f} %"
        print(f"{folder}: {outcome.reason} at step {outcome.step}{score}.", file=sys.stderr)
    return 0 if outcome.signal is None else STOPPED[signal.Signals(outcome.signal)]
