"""One training on 1, 2 and 4 devices of a CPU, and in 2 processes: losses, clouds a second, communication: make bench.

Devices of one CPU share its cores, so the clouds a second show what the sharing itself costs, not what more machines
would give. Each run is a process of its own, since the number of devices is fixed when JAX starts.
"""

import gzip
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
STEPS = 4
PER_DEVICE = 4  # clouds of a device where the batch grows with the devices
TOGETHER = 8  # clouds of all devices where it does not
# Devices of each process, processes.
RUNS = [(1, 1), (2, 1), (4, 1), (1, 2)]


def work(batch_size, number, processes, address):
    """A few steps of tiny.yaml in one process: seconds a step, share of communication, losses."""
    import jax
    import numpy as np

    from jprimfit.networks.segmenter import Segmenter
    from jprimfit.training import config as configs
    from jprimfit.training import parallel, profile, state, step
    from jprimfit.training.sources import open_sources

    if processes > 1:  # each on a core of its own, as on a machine of its own
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})
        parallel.initialise_distributed(address, processes, number)
    config = configs.read(ROOT / "configs" / "tiny.yaml", [f"train.batch_size={batch_size}"])
    sources = open_sources(config)
    rows = parallel.share(batch_size)
    batches = [step.Batch(sources.training.batch(n, batch_size), np.arange(batch_size)) for n in range(2 * STEPS)]
    batches = [jax.tree.map(lambda x: x[rows], batch) for batch in batches]
    cloud = jax.tree.map(lambda x: x[0], sources.training.batch(0, 1))
    start = state.create(step.initial_variables(Segmenter(config.model), cloud, config=config), config=config.optimizer)
    segmenter = Segmenter(config.model, axis_names=(step.CLOUD, parallel.AXIS))
    made = step.train_step(segmenter, config=config, num_steps=config.train.steps)
    devices = parallel.parallelise(made, kind=config.train.parallel)
    current, losses = devices.replicate(start), []

    def steps(some):
        nonlocal current
        for batch in some:
            current, metrics = devices.step(current, devices.shard(batch))
            losses.append(float(devices.first(metrics)["total"]))

    steps(batches[:1])
    begin = time.perf_counter()
    steps(batches[1:STEPS])
    seconds = (time.perf_counter() - begin) / (STEPS - 1)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            steps(batches[STEPS:])
        trace = next(Path(folder).rglob("*.trace.json.gz"))
        events = json.loads(gzip.decompress(trace.read_bytes()))["traceEvents"]
    times = profile.own_times(events)
    together = sum(spent for operation, spent in times if operation.startswith("all-reduce"))
    if parallel.is_writer():
        answer = {"seconds": seconds, "communication": together / sum(spent for _, spent in times), "losses": losses}
        sys.stdout.write(json.dumps(answer) + "\n")


def answer_of(devices, processes, batch_size):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    started = [
        subprocess.Popen(
            [sys.executable, __file__, *map(str, (batch_size, number, processes, address))],
            env=environment,
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        for number in range(processes)
    ]
    said = [process.communicate(timeout=1200)[0] for process in started]
    assert all(process.returncode == 0 for process in started)
    return json.loads(said[0].splitlines()[-1])


@pytest.mark.benchmark
def test_devices_and_processes():
    first = None
    for devices, processes in RUNS:
        number = devices * processes
        alike = answer_of(devices, processes, TOGETHER)
        first = first or alike["losses"]
        apart = [abs(a - b) / b for a, b in zip(alike["losses"], first, strict=True)]
        growing = answer_of(devices, processes, PER_DEVICE * number)
        sys.stdout.write(
            f"\n{processes} processes of {devices} devices: {TOGETHER} clouds a step {1e3 * alike['seconds']:.0f} ms, "
            f"losses within {apart[0]:.1e} of one device's, {max(apart):.1e} in {len(apart)} steps; "
            f"{PER_DEVICE} a device {1e3 * growing['seconds']:.0f} ms, "
            f"{PER_DEVICE * number / growing['seconds']:.1f} clouds/s, "
            f"communication {100 * growing['communication']:.1f} %"
        )
        assert apart[0] < 1e-5 and max(apart) < 1e-2
    sys.stdout.write("\n")


if __name__ == "__main__":
    batch, index, count = map(int, sys.argv[1:4])
    work(batch, index, count, sys.argv[4])
