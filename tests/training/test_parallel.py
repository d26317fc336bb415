"""One step gives the same gradients however many devices and processes share it."""

import os
import pickle
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jprimfit.training import parallel

ROOT = Path(__file__).resolve().parents[2]
# Difference, in units of the largest entry of each leaf. In float32 it is rounding (1e-7), enlarged where a gradient is
# a small sum of large terms: BatchNorm makes the loss nearly indifferent to the scale of what stands before it.
LARGEST = {"float32": 3e-5, "float64": 1e-9}

GRADIENTS = """
import pickle, sys
import jax, numpy as np
from jprimfit.networks.segmenter import Segmenter
from jprimfit.training import parallel, state, step
from jprimfit.training.config import from_mapping

source, target, dtype, runs, *distributed = sys.argv[1:]
if distributed:
    parallel.initialise_distributed(distributed[0], 2, int(distributed[1]))
mapping, example = pickle.load(open(source, "rb"))
config = from_mapping(mapping, source="test")

def cast(tree):
    return jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, tree)

initial = step.initial_variables(Segmenter(config.model), jax.tree.map(lambda x: x[0], example), config=config)
start, example = cast(state.create(initial, config=config.optimizer)), cast(example)
rows = parallel.share(config.train.batch_size)
batch = step.Batch(example, np.arange(config.train.batch_size, dtype=np.int32))
batch = jax.tree.map(lambda x: x[rows], batch)
segmenter = Segmenter(config.model, axis_names=("cloud", "device"))
answers = {}
for run in runs.split(","):
    kind, number = run.split(":")
    devices = parallel.parallelise(
        lambda s, b: (s, step.gradients(segmenter, s, b, config=config)), kind=kind, num_devices=int(number)
    )
    end, found = devices.step(devices.replicate(start), devices.shard(batch))
    jax.tree.map(np.testing.assert_array_equal, devices.first(end), start)
    answers[run] = devices.first(found)
if parallel.is_writer():
    pickle.dump(answers, open(target, "wb"))
"""


def gradients(folder, *, devices, dtype, runs, distributed=()):
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
        "JAX_ENABLE_X64": str(int(dtype == "float64")),
        "JAX_COMPILATION_CACHE_DIR": os.environ.get("JPRIMFIT_CACHE", str(ROOT / ".cache" / "jax")),
    }
    words = [sys.executable, "-c", GRADIENTS, folder / "in.pkl", folder / "out.pkl", dtype, runs, *distributed]
    return subprocess.Popen([str(word) for word in words], env=environment)


def worst(found, expected):
    """Largest difference in units of the largest entry of its leaf, over all leaves; tiny ones are noise around 0."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    scale = max(np.max(np.abs(leaf)) for leaf in jax.tree.leaves(expected))
    errors = jax.tree.map(lambda a, b: np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1e-3 * scale), found, expected)
    return max(jax.tree.leaves(errors))


@pytest.fixture
def inputs(tmp_path, toy_mapping, toy_batch):
    (tmp_path / "in.pkl").write_bytes(pickle.dumps((toy_mapping, toy_batch)))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_four_devices_and_two_processes_have_the_gradients_of_one_device(inputs, dtype, capsys):
    kinds = ("pmap", "shard_map")
    assert gradients(inputs, devices=4, dtype=dtype, runs="pmap:1,pmap:4,shard_map:4").wait() == 0
    answers = pickle.loads((inputs / "out.pkl").read_bytes())
    one = answers["pmap:1"]
    figures = {f"4 devices, {kind}": worst(answers[f"{kind}:4"], one) for kind in kinds}
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    both = [
        gradients(inputs, devices=2, dtype=dtype, runs="pmap:4,shard_map:4", distributed=(address, i)) for i in (0, 1)
    ]
    try:
        assert [process.wait(timeout=1800) for process in both] == [0, 0]
    finally:
        for process in both:  # one that has lost the other would wait for it for ever
            process.kill()
    answers = pickle.loads((inputs / "out.pkl").read_bytes())
    figures |= {f"2 processes, {kind}": worst(answers[f"{kind}:4"], one) for kind in kinds}
    with capsys.disabled():
        sys.stdout.write(f"\n{dtype}: " + ", ".join(f"{name} {value:.1e}" for name, value in figures.items()) + "\n")
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(one[2]))
    assert max(figures.values()) <= LARGEST[dtype]


@pytest.mark.parametrize("kind", ["pmap", "shard_map"])
def test_a_step_consumes_the_placed_state_and_leaves_the_given_one(kind):
    def step(state, batch):
        return {"x": state["x"] + lax.pmean(jnp.mean(batch), parallel.AXIS)}, {
            "seen": lax.psum(jnp.sum(batch), "device")
        }

    devices = parallel.parallelise(step, kind=kind, num_devices=1)
    given, batch = {"x": np.arange(3.0, dtype=np.float32)}, np.ones((4, 2), np.float32)
    placed = devices.replicate(given)
    after, metrics = devices.step(placed, devices.shard(batch))
    again, _ = devices.step(after, devices.shard(batch))
    np.testing.assert_array_equal(devices.first(again)["x"], [2, 3, 4])
    np.testing.assert_array_equal(given["x"], [0, 1, 2])
    assert devices.first(metrics)["seen"] == 8
    assert after["x"].is_deleted()


def test_one_process_has_all_rows_and_agrees_with_itself():
    assert parallel.share(6) == slice(0, 6)
    assert parallel.is_writer() and parallel.agreed(True) and not parallel.agreed(False)
    assert parallel.from_writer({"a": 1}) == {"a": 1}


def test_impossible_devices_and_addresses_are_refused():
    with pytest.raises(ValueError, match="train.devices is 99, but this run has"):
        parallel.parallelise(lambda s, b: (s, b), kind="pmap", num_devices=99)
    with pytest.raises(ValueError, match="--process-id 2; expected both"):
        parallel.initialise_distributed("127.0.0.1:1", 2, 2)
