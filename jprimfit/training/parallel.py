"""One step on many devices: everything of pmap, shard_map and jax.distributed is in this file.

A step is written for ONE device: `step(state, batch) -> (state, metrics)`. The state is the same on every device,
the batch is split along its leading axis into equal shares, and the axis "device" is at hand for collectives. The two
ways of running it give the same numbers: pmap, and shard_map under jit, the newer of the two. With several processes
(hosts) each calls the same functions in the same order and brings its own share of the batch.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

AXIS = "device"
Kind = Literal["pmap", "shard_map"]


class Parallel(NamedTuple):
    """A step on all devices, and how values get to them and back."""

    step: Callable[[Any, Any], tuple[Any, Any]]  # of a replicated state, which it consumes, and a shard-ed batch
    replicate: Callable[[Any], Any]  # a state of host arrays on every device; the given one stays whole
    shard: Callable[[Any], Any]  # this process's rows of a batch, cut into the shares of its devices
    first: Callable[[Any], Any]  # what the first device of this process holds of a replicated value, as host arrays
    num_devices: int  # of all processes


def parallelise(step: Callable[[Any, Any], tuple[Any, Any]], *, kind: Kind, num_devices: int | None = None) -> Parallel:
    """The step on the first num_devices devices (None: on all; several processes always use all).

    The metrics that step returns must be the same on every device (a pmean over "device" makes them so).
    """
    devices = jax.devices()
    if num_devices is not None:
        if not 1 <= num_devices <= len(devices) or (jax.process_count() > 1 and num_devices != len(devices)):
            raise ValueError(
                f"train.devices is {num_devices}, but this run has {len(devices)}: leave it out to use all."
            )
        devices = devices[:num_devices]
    return (_with_pmap if kind == "pmap" else _with_shard_map)(step, devices)


def place() -> tuple[int, int]:
    """Number of this process and number of all."""
    return jax.process_index(), jax.process_count()


def share(num_rows: int) -> slice:
    """The rows of a batch that this process has to bring: an equal, consecutive part."""
    index, count = place()
    return slice(num_rows // count * index, num_rows // count * (index + 1))


def is_writer() -> bool:
    """True in the one process that writes files and prints."""
    return jax.process_index() == 0


def agreed(flag: bool) -> bool:
    """Whether any process says so; a meeting point of all processes."""
    if jax.process_count() == 1:
        return flag
    from jax.experimental import multihost_utils

    return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def from_writer(value: Any) -> Any:
    """The writer's arrays in every process; a meeting point of all processes. Shapes and types must agree."""
    if jax.process_count() == 1:
        return value
    from jax.experimental import multihost_utils

    return multihost_utils.broadcast_one_to_all(value)


def initialise_distributed(
    coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None
) -> None:
    """Joins the processes of one training; to be called before any array is made.

    Args:
        coordinator: host:port of process 0; None or "auto" leaves all three to the cluster (Slurm, Open MPI,
            Kubernetes), which JAX asks.
        num_processes: of the whole run.
        process_id: of this one, 0 to num_processes - 1.
    """
    if coordinator in (None, "auto"):
        jax.distributed.initialize()
        return
    if num_processes is None or process_id is None or not 0 <= process_id < num_processes:
        raise ValueError(
            f"--coordinator {coordinator} came with --num-processes {num_processes} and --process-id {process_id}; "
            "expected both, with the id from 0 to one less than the number."
        )
    jax.distributed.initialize(coordinator, num_processes=num_processes, process_id=process_id)


def _with_pmap(step: Callable, devices: list) -> Parallel:
    num_local = _num_local(devices)
    run = jax.pmap(step, axis_name=AXIS, devices=devices, donate_argnums=(0,))
    place = jax.pmap(lambda x: x, axis_name=AXIS, devices=devices)

    def replicate(state: Any) -> Any:
        return place(jax.tree.map(lambda x: np.stack([np.asarray(x)] * num_local), state))

    def shard(batch: Any) -> Any:
        return jax.tree.map(lambda x: np.asarray(x).reshape(num_local, len(x) // num_local, *np.shape(x)[1:]), batch)

    def first(value: Any) -> Any:
        return jax.tree.map(lambda x: np.array(x.addressable_shards[0].data).reshape(x.shape[1:]), value)

    return Parallel(run, replicate, shard, first, len(devices))


def _with_shard_map(step: Callable, devices: list) -> Parallel:
    # Explicit axes, the default of make_mesh, refuse plain indexing of what is split.
    mesh = jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)
    everywhere, split = PartitionSpec(), PartitionSpec(AXIS)
    # With check_vma the gradient with respect to a replicated value is summed over devices already, so that the
    # pmean that pmap needs would be a silent factor; without it both have pmap's meaning.
    mapped = jax.shard_map(
        step, mesh=mesh, in_specs=(everywhere, split), out_specs=(everywhere, everywhere), check_vma=False
    )

    def put(tree: Any, spec: PartitionSpec) -> Any:
        sharding = NamedSharding(mesh, spec)
        return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), tree)

    def replicate(state: Any) -> Any:
        # A copy, because a placed array may share the memory of its source, which the step then consumes.
        return put(jax.tree.map(np.array, state), everywhere)

    def first(value: Any) -> Any:
        return jax.tree.map(lambda x: np.array(x.addressable_shards[0].data), value)

    return Parallel(
        jax.jit(mapped, donate_argnums=(0,)), replicate, lambda batch: put(batch, split), first, len(devices)
    )


def _num_local(devices: list) -> int:
    return sum(device.process_index == jax.process_index() for device in devices)
