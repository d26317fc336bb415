"""Clouds a second that processes draw for a training, and the memory of many batches: make bench.

JPRIMFIT_BATCHES sets the number of batches of the second (10,000).
"""

import os
import sys
import time
from pathlib import Path

import pytest

from jprimfit.data.clouds import LoaderConfig
from jprimfit.data.stream import Stream

FILE = Path(__file__).resolve().parents[2] / "jprimfit" / "assets" / "tiny.h5"


@pytest.mark.benchmark
@pytest.mark.parametrize("workers", [0, 1, 2])
def test_clouds_of_8192_points(workers):
    config = LoaderConfig(file=str(FILE), workers=workers, max_instances=64)
    with Stream(config, num_slots=64) as stream:
        for step in range(4):  # workers have started
            stream.batch(step, 16)
        start, began = time.perf_counter(), time.process_time()
        for step in range(4, 24):
            stream.batch(step, 16)
        rate, own = 320 / (time.perf_counter() - start), 320 / (time.process_time() - began)
    core = f", {own:5.0f} a second of this core" if workers == 0 else ""
    sys.stdout.write(f"\n{workers} workers: {rate:6.0f} clouds of 8,192 points a second{core}\n")


@pytest.mark.benchmark
def test_memory_stays_flat():
    count = int(os.environ.get("JPRIMFIT_BATCHES", "10000"))
    config = LoaderConfig(file=str(FILE), num_points=64, num_query=16, min_points=16, workers=1, max_instances=64)
    with Stream(config, num_slots=16) as stream:
        pid = stream._ring.workers[0].process.pid
        for step in range(count):
            stream.batch(step, 2)
            if step == count // 10:
                first = [resident_mb(number) for number in (os.getpid(), pid)]
        last = [resident_mb(number) for number in (os.getpid(), pid)]
    sys.stdout.write(f"\nMB of parent and worker after {count // 10} batches {first}, after {count} {last}\n")
    assert all(after - before < 10 for before, after in zip(first, last, strict=True))


def resident_mb(pid):
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
