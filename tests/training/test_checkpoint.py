"""What is saved is what is restored; damage of any kind is named, and an older checkpoint taken."""

import os
import re
import shutil
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.training.checkpoint import CheckpointError, Checkpoints, ForeignCheckpoint

ROOT = Path(__file__).resolve().parent.parent.parent


class Moments(NamedTuple):
    """As optax has them."""

    count: jax.Array
    mean: dict


def make_state(step, size=64):
    """A state with every sort of leaf; all its values depend on the step."""
    generator = np.random.default_rng(step)
    params = {"dense": {"kernel": generator.normal(size=(size, size)).astype(np.float32), "bias": np.zeros(3)}}
    return {
        "step": np.asarray(step, np.int32),
        "params": params,
        "optimizer": (Moments(jnp.int32(step), jax.tree.map(lambda x: jnp.asarray(x, jnp.bfloat16), params)), ()),
        "empty": np.zeros((0, 3), np.float32),
        "number": step,
        "average": None,
    }


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert type(one) is type(other) and np.asarray(one).dtype == np.asarray(other).dtype
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


def assert_one_sentence(text, *parts):
    assert text.endswith(".") and "\n" not in text and not re.search(r"[.!?] [A-Z]", text), text
    for part in parts:
        assert part in text


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with the checkpoints 1 (the best), 2 and 3."""
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    with Checkpoints(folder, config={"sizes": (1, 2.5), "name": "toy"}) as checkpoints:
        for step, miou in ((1, 0.9), (2, 0.5), (3, 0.6)):
            checkpoints.save(step, make_state(step), {"miou": miou})
    return folder


@pytest.fixture
def folder(written, tmp_path):
    """A copy to damage."""
    return shutil.copytree(written, tmp_path / "checkpoints")


def test_the_newest_comes_back_bit_for_bit(written):
    with Checkpoints(written, read_only=True) as checkpoints:
        step, state = checkpoints.restore(make_state(0))
        assert step == 3
        assert_same(state, make_state(3))
        record = checkpoints.record(3)
        assert record["config"] == {"sizes": [1, 2.5], "name": "toy"} and record["metrics"] == {"miou": 0.6}


def test_the_best_is_kept_beside_the_latest_two(tmp_path):
    scores = {1: 0.1, 2: 0.8, 3: 0.3, 4: float("nan"), 5: 0.4, 6: None}
    for stop in (3, 6):  # once more in a new process's stead: scores are read from disk
        with Checkpoints(tmp_path / "c") as checkpoints:
            for step in range(stop - 2, stop + 1):
                checkpoints.save(step, make_state(step), scores[step] and {"miou": scores[step]})
    with Checkpoints(tmp_path / "c") as checkpoints:
        assert checkpoints.steps() == (2, 5, 6)
        assert checkpoints.restore(make_state(0))[0] == 6
        step, state = checkpoints.restore_best(make_state(0))
        assert step == 2
        assert_same(state, make_state(2))


def test_nothing_there_is_none(tmp_path):
    with Checkpoints(tmp_path / "c") as checkpoints:
        assert checkpoints.restore(make_state(0)) is None and checkpoints.restore_best(make_state(0)) is None
        checkpoints.save(1, make_state(1))
        checkpoints.wait()
        assert checkpoints.restore_best(make_state(0)) is None and checkpoints.steps() == (1,)
    with pytest.raises(CheckpointError, match="absent is no folder of checkpoints"):
        Checkpoints(tmp_path / "absent", read_only=True)


def test_a_state_may_be_donated_at_once(tmp_path):
    step = jax.jit(lambda state: jax.tree.map(lambda x: x + 1, state), donate_argnums=0)
    state = {"x": jnp.zeros((256, 256)), "n": jnp.int32(0)}
    with Checkpoints(tmp_path / "c") as checkpoints:
        for number in range(4):
            checkpoints.save(number, state)
            state = step(state)
        _, found = checkpoints.restore(jax.eval_shape(lambda: state))
    np.testing.assert_array_equal(found["x"], 3)
    assert found["n"] == 3


def test_a_stored_step_is_left_and_an_earlier_one_refused(folder):
    with Checkpoints(folder) as checkpoints:
        checkpoints.save(3, make_state(9))
        assert_same(checkpoints.restore(make_state(0))[1], make_state(3))
        with pytest.raises(CheckpointError) as caught:
            checkpoints.save(2 - 2, make_state(0))
        assert_one_sentence(str(caught.value), str(folder), "holds a checkpoint of step 3")


def test_a_folder_that_cannot_be_one_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(CheckpointError) as caught:
        Checkpoints(tmp_path / "file")
    assert_one_sentence(str(caught.value), str(tmp_path / "file"))


def largest(folder):
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


def edit(path, change):
    content = bytearray(path.read_bytes())
    change(content)
    path.write_bytes(content)


def flip_bytes(content):
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(byte ^ 255 for byte in content[middle : middle + 64])


def flip_bit(content):
    content[len(content) // 2] ^= 1


def remove(place, name):
    found = list(place.rglob(name))
    assert found
    for path in found:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def replace(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def empty_all(place):
    for path in place.rglob("*"):
        if path.is_file():
            os.truncate(path, 0)


def take_from_older(place):
    shutil.rmtree(place / "state")
    shutil.copytree(place.parent / "2" / "state", place / "state")


DAMAGES = {
    "truncated data": lambda place: os.truncate(largest(place), 1000),
    "empty data": lambda place: os.truncate(largest(place), 0),
    "data absent": lambda place: largest(place).unlink(),
    "64 flipped bytes": lambda place: edit(largest(place), flip_bytes),
    "one flipped bit": lambda place: edit(largest(place), flip_bit),
    "text in place of data": lambda place: largest(place).write_text("Dear Sir,\n" * 2000),
    "manifest absent": lambda place: remove(place, "manifest.ocdbt"),
    "manifest garbage": lambda place: (place / "state" / "manifest.ocdbt").write_bytes(b"garbage" * 9),
    "tree metadata garbage": lambda place: (place / "state" / "_METADATA").write_text("{]"),
    "state absent": lambda place: remove(place, "state"),
    "state of another step": take_from_older,
    "record absent": lambda place: remove(place, "record"),
    "record empty": lambda place: os.truncate(place / "record" / "metadata", 0),
    "record garbage": lambda place: (place / "record" / "metadata").write_bytes(bytes(range(256))),
    "record of another program": lambda place: (place / "record" / "metadata").write_text('{"a": 1}'),
    "record no mapping": lambda place: (place / "record" / "metadata").write_text("[1, 2]"),
    "record of a later version": lambda place: replace(place / "record" / "metadata", '"version": 1', '"version": 2'),
    "checksum edited": lambda place: replace(place / "record" / "metadata", '"crc32": ', '"crc32": 1'),
    "all files empty": empty_all,
    "all files absent": lambda place: (shutil.rmtree(place), place.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_an_older_one_taken(folder, damage, capfd):
    DAMAGES[damage](folder / "3")
    with Checkpoints(folder) as checkpoints:
        step, state = checkpoints.restore(make_state(0))
    assert step == 2
    assert_same(state, make_state(2))
    noise = capfd.readouterr().err
    assert noise.startswith(f"jprimfit: {folder / '3'} is damaged (") and noise.endswith(": an older one is taken.\n")
    assert_one_sentence(noise.removesuffix("\n"))


@pytest.mark.parametrize("name", ["_METADATA", "commit_success.txt", "_CHECKPOINT_METADATA"])
def test_what_orbax_can_do_without_is_no_damage(folder, name, capfd):
    remove(folder / "3", name)
    with Checkpoints(folder) as checkpoints:
        step, state = checkpoints.restore(make_state(0))
    assert step == 3 and capfd.readouterr().err == ""
    assert_same(state, make_state(3))


def test_a_damaged_best_gives_way_to_the_next_best(folder, capfd):
    edit(largest(folder / "1"), flip_bytes)
    with Checkpoints(folder, read_only=True) as checkpoints:
        assert checkpoints.restore_best(make_state(0))[0] == 3
    assert f"{folder / '1'} is damaged" in capfd.readouterr().err


def test_after_damage_training_goes_on_and_saves_that_step_again(folder):
    edit(largest(folder / "3"), flip_bytes)
    for _ in range(2):  # the second time a folder of that name is there already
        with Checkpoints(folder) as checkpoints:
            assert checkpoints.restore(make_state(0))[0] == 2
            checkpoints.save(3, make_state(3))
        with Checkpoints(folder, read_only=True) as checkpoints:
            step, state = checkpoints.restore(make_state(0))
            assert step == 3
            assert_same(state, make_state(3))
        edit(largest(folder / "3"), flip_bytes)
    assert {path.name for path in folder.iterdir()} == {"1", "2", "3", "damaged-3", "damaged-3-2"}


def test_all_damaged_is_an_error_of_one_sentence(folder, capfd):
    for step in ("1", "2", "3"):
        os.truncate(largest(folder / step), 10)
    with Checkpoints(folder) as checkpoints, pytest.raises(CheckpointError) as caught:
        checkpoints.restore(make_state(0))
    assert_one_sentence(str(caught.value), str(folder), "all 3 are damaged", "--fresh")
    assert len(capfd.readouterr().err.splitlines()) == 3


def larger_kernel(state):
    state["params"]["dense"]["kernel"] = np.zeros((64, 65), np.float32)


def other_type(state):
    state["params"]["dense"]["bias"] = np.zeros(3, np.float32)


FOREIGN = {
    "shape": (larger_kernel, "in which params.dense.kernel is float32 (64, 64) instead of float32 (64, 65)"),
    "type": (other_type, "in which params.dense.bias is float64 (3,) instead of float32 (3,)"),
    "absent": (lambda state: state.update(average=np.zeros(2)), "which lacks average"),
    "additional": (lambda state: state.pop("number"), "which has number in addition"),
}


@pytest.mark.parametrize("difference", FOREIGN)
def test_a_checkpoint_of_another_network_is_refused(folder, difference, capfd):
    template = make_state(0)
    change, words = FOREIGN[difference]
    change(template)
    with Checkpoints(folder) as checkpoints, pytest.raises(ForeignCheckpoint) as caught:
        checkpoints.restore(template)
    assert_one_sentence(str(caught.value), str(folder / "3"), "is a checkpoint of another network", words)
    assert capfd.readouterr().err == ""


def test_reading_only_leaves_a_save_in_progress_alone(folder):
    unfinished = folder / "4.orbax-checkpoint-tmp"
    shutil.copytree(folder / "3", unfinished)
    with Checkpoints(folder, read_only=True) as checkpoints:
        assert checkpoints.restore(make_state(0))[0] == 3
    assert unfinished.exists()
    with Checkpoints(folder) as checkpoints:
        assert checkpoints.restore(make_state(0))[0] == 3
    for _ in range(100):  # Orbax clears up in a thread of its own
        if not unfinished.exists():
            break
        time.sleep(0.1)
    assert not unfinished.exists()


def run_python(code, *arguments, **environment):
    """A process with the package at hand and as many devices as asked for."""
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", **environment}
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process):
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out


PLACED = """
    import sys, jax, jax.numpy as jnp, numpy as np
    from jax.sharding import AxisType, NamedSharding, PartitionSpec
    from jprimfit.training.checkpoint import Checkpoints
    mesh = jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))
    replicated = NamedSharding(mesh, PartitionSpec())
    values = {"x": np.arange(6.0, dtype=np.float32).reshape(2, 3), "n": np.int32(7)}
    state = jax.device_put(values, replicated)
    with Checkpoints(sys.argv[1]) as checkpoints:
        if sys.argv[2] == "write":
            checkpoints.save(7, state)
        else:
            spec = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=replicated), state)
            for template in (state, spec):
                step, found = checkpoints.restore(template)
                assert step == 7 and found["x"].sharding == replicated
                for shard in found["x"].addressable_shards:
                    np.testing.assert_array_equal(shard.data, values["x"])
    print(jax.device_count())
"""


@pytest.mark.slow
@pytest.mark.parametrize(("writing", "reading"), [(1, 4), (4, 1), (4, 2)])
def test_another_number_of_devices_reads_it(tmp_path, writing, reading):
    for number, what in ((writing, "write"), (reading, "read")):
        flags = f"--xla_force_host_platform_device_count={number}"
        assert finish(run_python(PLACED, tmp_path / "c", what, XLA_FLAGS=flags)).strip() == str(number)


TWO = """
    import sys, jax, numpy as np
    jax.distributed.initialize(sys.argv[2], num_processes=2, process_id=int(sys.argv[3]), initialization_timeout=60)
    from jax.sharding import AxisType, NamedSharding, PartitionSpec
    from jprimfit.training.checkpoint import Checkpoints
    mesh = jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))
    replicated = NamedSharding(mesh, PartitionSpec())
    def make(step):
        values = np.random.default_rng(step).normal(size=(100, 100)).astype(np.float32)
        return {"x": jax.make_array_from_callback(values.shape, replicated, lambda index: values[index])}
    with Checkpoints(sys.argv[1]) as checkpoints:
        found = checkpoints.restore(make(0))
        first = 1 if found is None else found[0] + 1
        if found is not None:
            np.testing.assert_array_equal(*(x["x"].addressable_data(1) for x in (found[1], make(found[0]))))
        for step in range(first, first + 3):
            checkpoints.save(step, make(step), {"miou": 1 / step})
        checkpoints.wait()
        print(checkpoints.steps())
"""


@pytest.mark.slow
def test_two_processes_write_and_resume_together(tmp_path):
    flags = "--xla_force_host_platform_device_count=2"
    for expected in ("(1, 2, 3)", "(1, 4, 5)"):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{probe.getsockname()[1]}"
        both = [run_python(TWO, tmp_path / "c", address, rank, XLA_FLAGS=flags) for rank in (0, 1)]
        assert [finish(process).splitlines()[-1] for process in both] == [expected] * 2
        edit(largest(tmp_path / "c" / expected[-2]), flip_bit)  # both go back to 2, and 3 is written anew
    assert (tmp_path / "c" / "damaged-3").is_dir()


FULL = """
    import resource, signal, sys, numpy as np
    from jprimfit.training.checkpoint import Checkpoints
    small, large = {"x": np.zeros(5)}, {"x": np.random.default_rng(0).normal(size=10**6)}
    checkpoints = Checkpoints(sys.argv[1])
    checkpoints.save(1, small)
    checkpoints.wait()
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10**6, 10**6))  # stands for a full disk
    try:
        checkpoints.save(2, large)
        checkpoints.wait()
    except ValueError as error:
        print(error)
    with Checkpoints(sys.argv[1], read_only=True) as found:
        print(found.restore(small)[0])
"""


@pytest.mark.slow
def test_a_disk_that_is_full_is_one_sentence(tmp_path):
    sentence, step = finish(run_python(FULL, tmp_path / "c")).splitlines()
    assert_one_sentence(sentence, str(tmp_path / "c"), "cannot be written (")
    assert step == "1"


KILLED = """
    import sys, time, numpy as np
    from jprimfit.training.checkpoint import Checkpoints
    state = lambda step: {"x": np.full((1000, 4000), step, np.float32)}
    with Checkpoints(sys.argv[1]) as checkpoints:
        found = checkpoints.restore(state(0))
        print(0 if found is None else found[0], flush=True)
        assert found is None or (found[1]["x"] == found[0]).all()
        for step in range(found[0] + 1 if found else 1, 10**6):
            checkpoints.save(step, state(step))
            print(step, flush=True)
"""


@pytest.mark.slow
def test_a_kill_in_the_middle_of_a_save_loses_no_older_one(tmp_path):
    last = 0
    for milliseconds in (0, 3, 10, 40, 150, 400):
        process = run_python(KILLED, tmp_path / "c")
        begun = int(process.stdout.readline())
        assert begun >= last  # what was restored is at least what was there after the last kill
        for _ in range(3):  # the third save has begun, so the first one is on disk
            process.stdout.readline()
        time.sleep(milliseconds / 1000)
        process.kill()
        process.communicate(timeout=60)
        last = begun + 1
    with Checkpoints(tmp_path / "c") as checkpoints:
        step, state = checkpoints.restore({"x": np.zeros((1000, 4000), np.float32)})
    assert step >= last
    np.testing.assert_array_equal(state["x"], step)


@pytest.mark.slow
def test_any_flipped_bit_is_noticed_or_harmless(written, tmp_path, capfd):
    generator = np.random.default_rng(0)
    files = [path.relative_to(written) for path in sorted((written / "3").rglob("*")) if path.stat().st_size]
    files = [path for path in files if (written / path).is_file()]
    for number in range(150):
        folder = shutil.copytree(written, tmp_path / str(number))
        file = folder / files[number % len(files)]
        bit = int(generator.integers(8 * file.stat().st_size))
        edit(file, lambda content, bit=bit: content.__setitem__(bit // 8, content[bit // 8] ^ 1 << bit % 8))
        with Checkpoints(folder, read_only=True) as checkpoints:
            step, state = checkpoints.restore(make_state(0))
        assert_same(state, make_state(step))
        assert len(capfd.readouterr().err.splitlines()) == (step != 3)
        shutil.rmtree(folder)
