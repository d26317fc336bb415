"""Where the time of a training step goes, part by part: what the compiler's own trace of a few real steps says.

Operations of the compiled step bear the name of the module or scope they came from; the trace tells how long each of
them ran. Operations that others enclose (loops) count without those; nameless ones are of the part that uses their
result. Shares are of the time of all operations, which on several threads is more than that of the step. One device,
the settings of a training, batches drawn as it draws them.
"""

import gzip
import json
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jprimfit.io.text_table import text_table
from jprimfit.networks.segmenter import Segmenter
from jprimfit.training import state
from jprimfit.training.config import Config, num_steps
from jprimfit.training.parallel import AXIS
from jprimfit.training.sources import open_sources
from jprimfit.training.step import CLOUD, Batch, initial_variables, train_step

TRACED = 3  # steps
_SCOPES = ("inputs", "losses", "update")  # jax.named_scope in training/step and state
_OPERATION = re.compile(r"^\s*(?:ROOT )?%?([\w.-]+) = (.*)$", re.MULTILINE)
_SCOPE = re.compile(r'metadata=\{[^}]*op_name="([^"]*/[^"]*)"')
_OPERAND = re.compile(r"(?<![=\w])%([\w.-]+)")
_ROUNDS = 4  # in which nameless operations ask their neighbours


class Profile(NamedTuple):
    """Seconds, bytes and shares of one step."""

    batch_size: int
    draw_seconds: float  # of a batch on the host, which a training does beside the steps
    compile_seconds: float
    step_seconds: float
    num_bytes: int  # of parameters, batch and whatever lies between them
    parts: dict[str, tuple[float, float]]  # share of the time of all operations: forward, backward


def profile(config: Config) -> Profile:
    """Draws, compiles and traces a few steps of a training; nothing is kept.

    ValueError where the device's traces do not name its operations.
    """
    sources = open_sources(config)
    try:
        size = config.train.batch_size
        sources.training.batch(0, size)
        begin = time.perf_counter()
        batches = [sources.training.batch(step, size) for step in range(1, TRACED + 1)]
        draw = (time.perf_counter() - begin) / TRACED
        cloud = jax.tree.map(lambda x: x[0], batches[0])
        variables = initial_variables(Segmenter(config.model), cloud, config=config)
        steps = num_steps(config.train, sources.num_clouds)
    finally:
        sources.training.close()

    def alone(tree: Any) -> Any:
        return jax.tree.map(lambda x: np.asarray(x)[None], tree)

    segmenter = Segmenter(config.model, axis_names=(CLOUD, AXIS))
    step = jax.vmap(train_step(segmenter, config=config, num_steps=steps), axis_name=AXIS)
    first = alone(state.create(variables, config=config.optimizer))
    given = [alone(Batch(batch, np.arange(size, dtype=np.int32))) for batch in batches]
    begin = time.perf_counter()
    compiled = jax.jit(step).lower(first, given[0]).compile()
    spent = time.perf_counter() - begin
    jax.block_until_ready(compiled(first, given[0]))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            begin = time.perf_counter()
            for batch in given:
                jax.block_until_ready(compiled(first, batch))
            seconds = (time.perf_counter() - begin) / TRACED
        traces = sorted(Path(folder).rglob("*.trace.json.gz"))
        events = json.loads(gzip.decompress(traces[-1].read_bytes()))["traceEvents"] if traces else []
    parts = shares(events, scopes(compiled.as_text() or ""))
    memory = compiled.memory_analysis()
    num_bytes = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    return Profile(size, draw, spent, seconds, num_bytes, parts)


def scopes(program: str) -> dict[str, str]:
    """Where each operation of a compiled program (HLO text) came from; of a nameless one, what uses it or is used."""
    scope_of, uses, used_by = {}, {}, defaultdict(list)
    for name, words in _OPERATION.findall(program):
        told = _SCOPE.search(words)
        if told:
            scope_of[name] = told[1]
        uses[name] = _OPERAND.findall(words)
        for operand in uses[name]:
            used_by[operand].append(name)
    for _ in range(_ROUNDS):
        found = {}
        for name in uses:
            if name not in scope_of:
                around = [scope_of[other] for other in (*used_by[name], *uses[name]) if other in scope_of]
                if around:
                    found[name] = around[0]
        scope_of |= found
    return scope_of


def shares(events: Iterable[Mapping[str, Any]], scope_of: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Forward and backward share of every part in the time of a trace's operations, the longest part first.

    events: of a Chrome trace; those of operations have args.hlo_op. scope_of: where each operation came from.
    """
    total: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for operation, seconds in own_times(events):
        part, backward = _part(scope_of.get(operation, ""))
        total[part][backward] += seconds
    whole = sum(map(sum, total.values()))
    if whole <= 0:
        raise ValueError("The traces of this device name no operations: profile on another one.")
    ordered = sorted(total.items(), key=lambda item: -sum(item[1]))
    return {part: (times[0] / whole, times[1] / whole) for part, times in ordered}


def text(found: Profile) -> str:
    """The profile for people."""
    rows = [
        [part, *(f"{100 * share:.1f} %" for share in (forward + backward, forward, backward))]
        for part, (forward, backward) in found.parts.items()
    ]
    speed = found.batch_size / found.step_seconds
    return (
        f"{text_table(['part', 'time', 'forward', 'backward'], rows)}\n\n"
        f"step of {found.batch_size} clouds: {1e3 * found.step_seconds:.0f} ms, {speed:.1f} clouds/s, "
        f"{found.num_bytes / 1e9:.2f} GB; compiled in {found.compile_seconds:.0f} s; "
        f"a batch is drawn in {1e3 * found.draw_seconds:.0f} ms beside it"
    )


def own_times(events: Iterable[Mapping[str, Any]]) -> list[tuple[str, float]]:
    """Every operation of a trace and its time without that of the operations inside it."""
    threads: dict[Any, list[Mapping[str, Any]]] = defaultdict(list)
    for event in events:
        if event.get("ph") == "X" and "hlo_op" in event.get("args", {}):
            threads[event["pid"], event["tid"]].append(event)
    found = []
    for several in threads.values():
        open_: list[list[Any]] = []  # end, operation, own time of those that are running
        for event in sorted(several, key=lambda e: (e["ts"], -e["dur"])):
            while open_ and open_[-1][0] <= event["ts"]:
                found.append(tuple(open_.pop()[1:]))
            length = float(event["dur"])
            if open_:
                open_[-1][2] -= length
            open_.append([event["ts"] + length, event["args"]["hlo_op"], length])
        found += [tuple(one[1:]) for one in open_]
    return found


def _part(scope: str) -> tuple[str, bool]:
    """The part of a step that a scope such as "jit(f)/vmap(transpose(jvp(Segmenter)))/backbone/encoder_1/mul" is of."""
    backward = "transpose(" in scope
    words = [word for word in re.split(r"[/()]", scope) if word]
    for name in _SCOPES:
        if name in words:
            return name, backward
    if "Segmenter" not in words:
        return "other", backward
    inside = words[words.index("Segmenter") + 1 :]
    if inside[:1] != ["backbone"]:
        return "heads", backward
    level = next((word for word in inside if re.fullmatch(r"(encoder|decoder)_\d+.*|stem", word)), "backbone")
    return re.sub(r"(coder_\d+).*", r"\1", level).replace("_", " "), backward
