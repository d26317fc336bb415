"""PointConv layers of the published sizes in JAX and, operation by operation the same, in PyTorch: make bench.

PyTorch is no dependency: without it this is skipped. Both have the same weights and are held to the same answer, in
training, where BatchNorm normalises by the statistics of what it sees; both use all cores.
"""

import os
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import host
from jprimfit.geometry.density import relative_inverse_density
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.networks.layers import EPSILON
from jprimfit.networks.pointconv import PointConv, PointConvConfig

SPEC, CONFIG = HierarchySpec(), PointConvConfig()  # the published sizes
SECONDS = 3.0  # of repetitions
ENCODER, DECODER = CONFIG.encoder, CONFIG.decoder
LAYERS = {  # name: (level of the points, level of the centroids, channels in, pointwise widths, channels out)
    "encoder level 1": (0, 1, 3, ENCODER[0][:-1], ENCODER[0][-1]),
    "encoder level 2": (1, 2, ENCODER[0][-1], ENCODER[1][:-1], ENCODER[1][-1]),
    "encoder level 3": (2, 3, ENCODER[1][-1], ENCODER[2][:-1], ENCODER[2][-1]),
    "decoder level 1": (1, 1, DECODER[1][0], (), DECODER[1][1]),
    "decoder level 2": (2, 2, DECODER[2][0], (), DECODER[2][1]),
}


def fastest(run):
    seconds, begin = [], time.perf_counter()
    run()
    while len(seconds) < 3 or time.perf_counter() - begin < SECONDS:
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return 1e3 * min(seconds)


def torch_layer(torch, weights, offset, index, mask, density, features):
    """The grouped PointConv of networks/pointconv.py for one cloud; weights: of the Flax module, as tensors."""

    def norm(x, name):
        rows = x.reshape(-1, x.shape[-1])
        known = weights[name]["scale"], weights[name]["shift"]
        rows = torch.nn.functional.batch_norm(rows, None, None, *known, training=True, eps=EPSILON)
        return torch.relu(rows).reshape(x.shape)

    def pointwise(x, name, count):
        for number in range(count):
            x = norm(x @ weights[f"{name}/Dense_{number}"]["kernel"], f"{name}/BatchNorm_{number}")
        return x

    grouped = torch.cat([offset, features[index]], dim=-1)
    grouped = pointwise(grouped, "mlp", sum(name.startswith("mlp/Dense") for name in weights))
    scale = pointwise(density, "density_net", 1) @ weights["density_scale"]["kernel"] + weights["density_scale"]["bias"]
    factors = pointwise(offset, "weight_net", 1) * torch.sigmoid(scale) * mask
    x = torch.einsum("mkv,mkc->mvc", factors, grouped)
    return norm(x.reshape(len(x), -1) @ weights["kernel"]["kernel"], "norm")


def flat(params, path=""):
    """{"mlp/Dense_0": {"kernel": ...}, ...}"""
    if not isinstance(next(iter(params.values())), dict):
        return {path: params}
    return {key: value for name in params for key, value in flat(params[name], f"{path}/{name}".strip("/")).items()}


def times(torch, hierarchy, fine, level, channels, mlp, out):
    """Milliseconds of one layer: forward, forward + backward, in JAX and in PyTorch, whose answers agree."""
    groups = hierarchy.encoder_groups[fine] if fine != level else hierarchy.decoder_groups[fine]
    points, centroids, density = hierarchy.points[fine], hierarchy.points[level], hierarchy.density[fine]
    features = jnp.asarray(np.random.default_rng(1).normal(size=(len(points), channels)), jnp.float32)
    inputs = (centroids, centroids, points, points, hierarchy.mask[fine])
    module = PointConv(out, CONFIG, mlp, axis_names=())
    variables = module.init(jax.random.key(0), *inputs, features, density, groups, train=False)
    params = variables["params"]

    @jax.jit
    def forward(params, features):
        given = (*inputs, features, density, groups)
        return module.apply({**variables, "params": params}, *given, train=True, mutable=["batch_stats"])[0]

    both = jax.jit(jax.value_and_grad(lambda *free: jnp.sum(jnp.square(forward(*free))), argnums=(0, 1)))

    def tensor(x, learnt=False):
        return torch.tensor(np.asarray(x), requires_grad=learnt)

    index = np.asarray(groups.index)
    offset = np.asarray(points)[index] - np.asarray(centroids)[:, None]
    relative = relative_inverse_density(density, groups)[..., None]
    known = [tensor(x) for x in (offset, index.astype(np.int64), groups.mask[..., None], relative)]
    weights = {key: {k: tensor(v, learnt=True) for k, v in some.items()} for key, some in flat(params).items()}
    seen = tensor(features, learnt=True)
    leaves = [seen, *(leaf for some in weights.values() for leaf in some.values())]

    def other():
        with torch.no_grad():
            return torch_layer(torch, weights, *known, seen)

    def other_both():
        return torch.autograd.grad(torch_layer(torch, weights, *known, seen).square().sum(), leaves)

    np.testing.assert_allclose(forward(params, features), other().numpy(), atol=2e-3, rtol=2e-3)
    ours = [fastest(lambda run=run: jax.block_until_ready(run(params, features))) for run in (forward, both)]
    theirs = [fastest(run) for run in (other, other_both)]
    return ours, theirs


@pytest.mark.benchmark
def test_layers_beside_pytorch():
    torch = pytest.importorskip("torch")
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    points = np.random.default_rng(0).normal(size=(8192, 3))
    points = (points / np.sqrt(np.sum(points**2, axis=1, keepdims=True))).astype(np.float32)
    hierarchy = jax.tree.map(jnp.asarray, host.build_hierarchy(points, spec=SPEC))
    sys.stdout.write("\nms of one cloud of 8,192 points, forward and forward + backward: JAX, PyTorch, ratio\n")
    for name, layer in LAYERS.items():
        ours, theirs = times(torch, hierarchy, *layer)
        figures = "   ".join(f"{a:6.1f} {b:6.1f} {b / a:5.2f}" for a, b in zip(ours, theirs, strict=True))
        sys.stdout.write(f"{name:16s} {figures}\n")
