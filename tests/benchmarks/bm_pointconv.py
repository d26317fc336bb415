"""Time and memory of PointConv with and without the matrix reordering, and of real steps of paper.yaml: make bench."""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import host
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.networks import pointconv
from jprimfit.networks.pointconv import PointConv, PointConvConfig, PointConvNet

ROOT = Path(__file__).resolve().parents[2]
SPEC, CONFIG = HierarchySpec(), PointConvConfig()  # the published sizes
MIB = 1 << 20
LAYERS = {  # name: (level of the points, level of the centroids, channels in, pointwise widths, channels out)
    "encoder level 1": (0, 1, 3, CONFIG.encoder[0][:-1], CONFIG.encoder[0][-1]),
    "decoder level 2": (2, 2, CONFIG.decoder[2][0], (), CONFIG.decoder[2][1]),
}
SECONDS = 2.0  # of repetitions


def surface():
    """8,192 points of a sphere, and their hierarchy."""
    points = np.random.default_rng(0).normal(size=(8192, 3))
    points = (points / np.sqrt(np.sum(points**2, axis=1, keepdims=True))).astype(np.float32)
    return jax.tree.map(jnp.asarray, host.build_hierarchy(points, spec=SPEC))


def unreordered(module, variables, inputs, monkeypatch):
    """The same layer, with a weight matrix (c_in, c_out) formed for every neighbour of every centroid."""
    factors = []

    def keep(weights, grouped):
        factors[:] = weights, grouped
        return jnp.zeros((weights.shape[0], weights.shape[2], grouped.shape[2]), grouped.dtype)

    def instead(dense, args, kwargs, context):
        if context.module.name != "kernel":
            return dense(*args, **kwargs)
        weights, grouped = factors
        basis = context.module.get_variable("params", "kernel")
        basis = basis.reshape(weights.shape[2], grouped.shape[2], -1)
        return jnp.einsum("mkc,mkcd->md", grouped, jnp.einsum("mkv,vcd->mkcd", weights, basis))

    monkeypatch.setattr(pointconv, "weighted_sum", keep)
    with nn.intercept_methods(instead):
        return module.apply(variables, *inputs, train=False)


def measure(function, *inputs):
    """Fastest run in ms, and MiB of temporaries that XLA allots beside inputs and outputs."""
    compiled = jax.jit(function).lower(*inputs).compile()
    seconds, begin = [], time.perf_counter()
    while len(seconds) < 2 or time.perf_counter() - begin < SECONDS:
        start = time.perf_counter()
        jax.block_until_ready(compiled(*inputs))
        seconds.append(time.perf_counter() - start)
    return 1e3 * min(seconds), compiled.memory_analysis().temp_size_in_bytes / MIB


def report(name, forward, backward):
    sys.stdout.write(
        f"{name:34s} forward {forward[0]:7.1f} ms {forward[1]:7.0f} MiB"
        f"   forward + backward {backward[0]:7.1f} ms {backward[1]:7.0f} MiB\n"
    )


@pytest.mark.benchmark
def test_reordering(monkeypatch):
    hierarchy = surface()
    sys.stdout.write("\nPointConv, 8,192 points, batch 1, published widths; MiB are temporaries\n")
    for name, (fine, level, channels, mlp, out) in LAYERS.items():
        groups = hierarchy.encoder_groups[fine] if fine != level else hierarchy.decoder_groups[fine]
        points, centroids = hierarchy.points[fine], hierarchy.points[level]
        features = jnp.asarray(np.random.default_rng(1).normal(size=(len(points), channels)), jnp.float32)
        inputs = (centroids, centroids, points, points, hierarchy.mask[fine], features, hierarchy.density[fine], groups)
        module = PointConv(out, CONFIG, mlp)
        variables = module.init(jax.random.key(0), *inputs, train=False)

        def plain(variables, inputs, module=module):
            return module.apply(variables, *inputs, train=False)

        def explicit(variables, inputs, module=module):
            with monkeypatch.context() as patch:
                return unreordered(module, variables, inputs, patch)

        answers = []
        for words, function in (("reordered", plain), ("every W formed", explicit)):
            answers.append(function(variables, inputs))

            def score(free, variables, inputs, function=function):
                variables, inputs = {**variables, "params": free[0]}, (*inputs[:5], free[1], *inputs[6:])
                return jnp.sum(jnp.square(function(variables, inputs)))

            slopes = measure(jax.grad(score), (variables["params"], features), variables, inputs)
            report(f"{name}, {words}", measure(function, variables, inputs), slopes)
        np.testing.assert_allclose(*answers, atol=1e-4, rtol=1e-4)
        m, k = groups.index.shape
        size = 4 * m * k * ((mlp[-1] if mlp else channels + 3) * out)
        sys.stdout.write(f"{'':34s} W alone: {size / MIB:,.0f} MiB\n")
    k, width, out = SPEC.decoder_neighbors[0], CONFIG.decoder[0][0] + 3, CONFIG.decoder[0][1]
    for batch in (1, 32):
        size = 4 * batch * 8192 * k * width * out
        sys.stdout.write(f"at full resolution (decoder level 0), batch {batch:2d}, W would take {size / 1e9:,.1f} GB\n")


@pytest.mark.benchmark
def test_whole_backbone():
    hierarchy = surface()
    net = PointConvNet(CONFIG)
    inputs = (hierarchy, hierarchy.points[0], hierarchy.points[0])
    variables = jax.jit(lambda *x: net.init(jax.random.key(0), *x, train=False))(*inputs)

    def forward(params, hierarchy):
        return net.apply({**variables, "params": params}, hierarchy, *inputs[1:], train=False)

    def score(params, hierarchy):
        return jnp.sum(jnp.square(forward(params, hierarchy)))

    arguments = (variables["params"], hierarchy)
    sys.stdout.write("\n")
    report("PointConv, all layers", measure(forward, *arguments), measure(jax.grad(score), *arguments))


STEPS = 4


@pytest.mark.benchmark
@pytest.mark.parametrize("batch_size", [1, 2])
def test_steps_of_the_paper(batch_size, tmp_path):
    settings = [
        "data.file=jprimfit/assets/tiny.h5",
        "data.num_clouds=4",
        "validation.num_clouds=1",
        "data.cache=" + str(tmp_path / "pools"),
        "validation.cache=" + str(tmp_path / "pools"),
        f"train.batch_size={batch_size}",
        f"train.steps={STEPS}",
        "train.log_every=1",
        "train.validate_every=0",
        "train.validation_batch_size=1",
        "train.checkpoint_every=1000",
    ]
    command = [sys.executable, "train.py", "--config", "configs/paper.yaml", "--workdir", str(tmp_path / "run")]
    done = subprocess.run([*command, *settings], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    steps = [line for line in lines if line["kind"] == "train"]
    assert len(steps) == STEPS and all(np.isfinite(line["total"]) for line in steps)
    seconds = [batch_size / line["clouds_per_second"] for line in steps[1:]]  # the first one compiles
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024  # of the largest child so far
    sys.stdout.write(
        f"\npaper.yaml, batch {batch_size}: {min(seconds):.1f} s a step (all: "
        f"{', '.join(f'{value:.1f}' for value in seconds)}), peak memory {peak:,.0f} MiB\n"
    )
