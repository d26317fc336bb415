"""A shipped model: what is saved is what is loaded, equal models are equal files, and every damage has its sentence."""

import hashlib
import io
import json
import re
import shutil
import zipfile

import jax
import numpy as np
import pytest
import yaml

from jprimfit.apps.main import main
from jprimfit.geometry.hierarchy import HierarchySpec
from jprimfit.networks import weights
from jprimfit.networks.pointconv import PointConvConfig
from jprimfit.networks.segmenter import SegmenterConfig
from jprimfit.networks.weights import Model

SPEC = HierarchySpec((8, 4), (4, 4), (0, 4), (4, 4), (0.4, 0.8), (0.2, 0.4), (float("inf"),) * 2)
CONFIG = SegmenterConfig(
    hierarchy=SPEC,
    pointconv=PointConvConfig(encoder=((8, 8), (8, 8)), decoder=((8,), (8, 8)), weight_channels=4),
    features=("xyz", "pca"),
    shared=8,
    num_slots=5,
)
KERNEL = "params/shared/Dense_0/kernel"


@pytest.fixture(scope="module")
def model():
    """Random numbers in the shapes of a small network."""
    generator = np.random.default_rng(0)
    shapes = weights.expected_shapes(CONFIG)
    arrays = {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return Model(CONFIG, weights._nested(arrays), "toy", {"steps": 7, "rate": 1e-5, "loss": ["miou", "normal"]})


@pytest.fixture
def stem(model, tmp_path):
    """Its files, to be damaged."""
    weights.save(tmp_path / "toy.v1", model)
    return tmp_path / "toy.v1"


def paths(stem):
    return stem.with_name(stem.name + ".npz"), stem.with_name(stem.name + ".yaml")


def assert_one_sentence(text):
    assert text.endswith((".", "?")) and "\n" not in text and not re.search(r"[.!?] [A-Z]", text), text


def test_what_is_saved_is_loaded(model, stem):
    for name in (stem, str(stem), *paths(stem), stem.parent):
        found = weights.load(name)
        assert found.config == model.config and found.name == "toy" and found.info == model.info
        assert jax.tree.structure(found.variables) == jax.tree.structure(model.variables)
        jax.tree.map(np.testing.assert_array_equal, found.variables, model.variables)


def test_numpy_reads_the_arrays_too(model, stem):
    with np.load(paths(stem)[0]) as archive:
        assert set(archive.files) == set(weights.expected_shapes(CONFIG))
        np.testing.assert_array_equal(archive[KERNEL], model.variables["params"]["shared"]["Dense_0"]["kernel"])


def test_equal_models_are_equal_files(model, stem, tmp_path):
    for one, other in zip(paths(stem), weights.save(tmp_path / "again", model), strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert len(list(tmp_path.iterdir())) == 4  # nothing half written is left


def test_half_precision_rounds_weights_as_told_and_leaves_statistics(model, stem, tmp_path):
    weights.save(tmp_path / "half", model, precision="float16")
    found = weights.load(tmp_path / "half")
    jax.tree.map(np.testing.assert_array_equal, found.variables["batch_stats"], model.variables["batch_stats"])
    half = jax.tree.map(lambda x: x.astype(np.float16).astype(np.float32), model.variables["params"])
    jax.tree.map(np.testing.assert_array_equal, found.variables["params"], half)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(found.variables))
    differences = jax.tree.map(lambda a, b: np.max(np.abs(a - b)), found.variables, model.variables)
    assert yaml.safe_load((tmp_path / "half.yaml").read_text())["rounding"] == max(jax.tree.leaves(differences)) > 0
    assert yaml.safe_load(paths(stem)[1].read_text())["rounding"] == 0
    assert (tmp_path / "half.npz").stat().st_size < 0.9 * paths(stem)[0].stat().st_size


@pytest.mark.parametrize(
    ("value", "precision", "words"),
    [(np.nan, "float32", "not finite"), (np.inf, "float16", "not finite"), (7e4, "float16", "beyond float16")],
)
def test_what_cannot_be_stored_is_not_written(model, tmp_path, value, precision, words):
    variables = jax.tree.map(np.copy, model.variables)
    variables["params"]["shared"]["Dense_0"]["kernel"][0, 0] = value
    with pytest.raises(ValueError, match=f"{tmp_path / 'toy'} is not written, {KERNEL} .*{words}") as caught:
        weights.save(tmp_path / "toy", model._replace(variables=variables), precision=precision)
    assert_one_sentence(str(caught.value))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", [".", "best", "checkpoints", "checkpoints/500"])
def test_a_workdir_gives_its_best_exported_model(model, tmp_path, place):
    (tmp_path / "checkpoints" / "500").mkdir(parents=True)
    (tmp_path / "config.yaml").write_text("seed: 1\n")
    with pytest.raises(
        ValueError, match="is no model" if place == "best" else "holds a training that has not exported a model yet"
    ):
        weights.load(tmp_path / place)
    weights.save(tmp_path / "last" / "weights", model._replace(name="last"))
    if place != "best":
        assert weights.load(tmp_path / place).name == "last"
    weights.save(tmp_path / "best" / "weights", model._replace(name="best"))
    assert weights.load(tmp_path / place).name == "best"


def test_several_models_in_a_folder_are_listed(model, stem):
    weights.save(stem.parent / "other", model)
    with pytest.raises(ValueError, match=r"holds 2 models \(other, toy.v1\): name the one you mean") as caught:
        weights.load(stem.parent)
    assert_one_sentence(str(caught.value))


def test_shipped_models_are_found_by_name_and_are_those_of_this_code():
    for name in weights.SHIPPED:
        found = weights.load(name)
        assert found.name == name
        shapes = {key: array.shape for key, array in weights._flat(found.variables).items()}
        weights.check_shapes(found.config, shapes, source=name)


def test_a_name_is_looked_up_among_the_shipped(model, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "ASSETS", tmp_path)
    weights.save(tmp_path / "spfn", model._replace(name="spfn"))
    assert weights.load("spfn").name == "spfn"
    with pytest.raises(ValueError, match="the model 'default' is not shipped"):
        weights.load("default")


# What follows damages one of the two files; `sealed` ones have a YAML whose own checksum is right again.


def edited(stem, change):
    """The YAML after change(document), with a checksum that fits."""
    path = paths(stem)[1]
    document = yaml.safe_load(path.read_text())
    change(document)
    document["sha256"] = weights._digest(document)
    path.write_text(yaml.safe_dump(document, sort_keys=False))


def repacked(stem, change):
    """The archive after change({name: bytes of the .npy})."""
    path = paths(stem)[0]
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def put(array, *, told=False, **options):
    """A damage: another array in the kernel's place, of which the YAML may be told."""

    def damage(stem):
        repacked(stem, lambda members: members.update({f"{KERNEL}.npy": npy(array, **options)}))
        if told:
            edited(stem, lambda document: document["arrays"].update({KERNEL: weights._words(array)}))

    return damage


def replaced(old, new):
    def damage(stem):
        path = paths(stem)[1]
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))

    return damage


def flipped_in_archive(stem):
    content = bytearray(paths(stem)[0].read_bytes())
    place = content.index(KERNEL.encode()) + 300
    content[place] ^= 16
    paths(stem)[0].write_bytes(content)


def zip_bomb(stem):
    path = paths(stem)[0]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in weights.expected_shapes(CONFIG):
            archive.writestr(f"{name}.npy", b"\0" * 300_000)


def lying_header(stem):
    """An array of a petabyte, as far as its header goes."""
    header = npy(np.zeros((8, 8), np.float32)).replace(b"(8, 8)", b"(99999999, 9999999)")
    repacked(stem, lambda members: members.update({f"{KERNEL}.npy": header}))


def truncated(which):
    def damage(stem):
        path = paths(stem)[which]
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return damage


def drop(mapping, key):
    del mapping[key]


def other_config(document):
    document["config"]["shared"] = 16


def impossible_config(document):
    document["config"]["features"] = []


def bombed_yaml(stem):
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{b}: &{b} [{', '.join(['*' + a] * 9)}]" for a, b in zip("abcdefghi", "bcdefghij", strict=True)]
    paths(stem)[1].write_text("\n".join(lines))


NPZ, YAML = 0, 1
DAMAGES = {  # name: (what is done, which file is named, words)
    "npz truncated": (truncated(NPZ), NPZ, "is damaged"),
    "npz empty": (lambda stem: paths(stem)[NPZ].write_bytes(b""), NPZ, "is damaged"),
    "npz absent": (lambda stem: paths(stem)[NPZ].unlink(), NPZ, "lacks toy.v1.npz beside it"),
    "npz is text": (lambda stem: paths(stem)[NPZ].write_text("Dear Sir,\n" * 99), NPZ, "is damaged"),
    "npz is a folder": (lambda stem: (paths(stem)[NPZ].unlink(), paths(stem)[NPZ].mkdir()), NPZ, "lacks toy.v1.npz"),
    "bit flipped": (flipped_in_archive, NPZ, "is damaged (Bad CRC-32"),
    "other numbers": (put(np.ones((8, 8), np.float32)), NPZ, f"{KERNEL} has other bits than were saved"),
    "NaN": (put(np.full((8, 8), np.nan, np.float32), told=True), NPZ, f"{KERNEL} holds values that are not finite"),
    "pickle": (put(np.full((8, 8), {}), allow_pickle=True), NPZ, "holds object where float32"),
    "other type": (put(np.ones((8, 8), np.float64)), NPZ, "holds float64 where float32"),
    "other byte order": (put(np.ones((8, 8), ">f4")), NPZ, "holds >f4 where float32"),
    "columns first": (put(np.asfortranarray(np.ones((8, 8), np.float32))), NPZ, "holds"),
    "other shape": (put(np.ones((4, 16), np.float32)), NPZ, "has shape (4, 16) where (8, 8)"),
    "too few numbers": (put(np.ones((8, 7), np.float32)), NPZ, "has shape (8, 7) where (8, 8)"),
    "array absent": (lambda stem: repacked(stem, lambda m: drop(m, f"{KERNEL}.npy")), NPZ, f"lacks the array {KERNEL}"),
    "array in addition": (lambda stem: repacked(stem, lambda m: m.update({"x.npy": npy(1)})), NPZ, "it holds 'x'"),
    "zip bomb": (zip_bomb, NPZ, "has 300000 bytes where"),
    "header of a petabyte": (lying_header, NPZ, "has shape (99999999, 9999999)"),
    "yaml absent": (lambda stem: paths(stem)[YAML].unlink(), YAML, "lacks toy.v1.yaml beside it"),
    "yaml empty": (lambda stem: paths(stem)[YAML].write_bytes(b""), YAML, "no YAML of a jprimfit model"),
    "yaml truncated": (truncated(YAML), YAML, ""),
    "yaml is binary": (lambda stem: paths(stem)[YAML].write_bytes(bytes(range(256))), YAML, ""),
    "yaml is no mapping": (lambda stem: paths(stem)[YAML].write_text("[1, 2]"), YAML, ""),
    "yaml of brackets": (
        lambda stem: paths(stem)[YAML].write_text("[" * 50_000),
        YAML,
        "it has aliases or more than 32 levels",
    ),
    "yaml of aliases": (bombed_yaml, YAML, "has aliases or more"),
    "yaml is huge": (lambda stem: paths(stem)[YAML].write_text("# \n" * 2**20), YAML, "bytes where a model's YAML has"),
    "yaml of another program": (replaced("jprimfit-weights", "onnx"), YAML, "no YAML of a jprimfit model"),
    "later version": (replaced("version: 1", "version: 2"), YAML, "its version is 2 and this jprimfit reads 1"),
    "config edited": (replaced("num_slots: 5", "num_slots: 6"), YAML, "has changed since it was written"),
    "checksum edited": (replaced("sha256: ", "sha256: 0"), YAML, "has changed since it was written"),
    "key absent": (lambda stem: edited(stem, lambda d: drop(d, "config")), YAML, "lacks the key 'config'"),
    "sealed: no checksum": (
        lambda stem: edited(stem, lambda d: d["arrays"].update({KERNEL: "float32 8x8"})),
        YAML,
        f"it says 'float32 8x8' of {KERNEL}",
    ),
    "sealed: other network": (lambda stem: edited(stem, other_config), YAML, "in the network of its config"),
    "sealed: unknown setting": (lambda stem: edited(stem, lambda d: d["config"].update(slots=3)), YAML, "slots"),
    "sealed: impossible network": (lambda stem: edited(stem, impossible_config), YAML, "no network can be made"),
    "sealed: array untold": (
        lambda stem: edited(stem, lambda d: drop(d["arrays"], KERNEL)),
        YAML,
        f"it lacks {KERNEL}, which the network of its config has",
    ),
    "sealed: array nobody knows": (
        lambda stem: edited(stem, lambda d: d["arrays"].update({"params/x": d["arrays"][KERNEL]})),
        YAML,
        "it holds params/x, which the network of its config has not",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_one_sentence_that_names_the_file(stem, damage):
    act, which, words = DAMAGES[damage]
    act(stem)
    with pytest.raises(ValueError) as caught:
        weights.load(stem)
    assert_one_sentence(str(caught.value))
    assert paths(stem)[which].name in str(caught.value) and str(stem.parent) in str(caught.value)
    assert words in str(caught.value)


def test_more_numbers_than_any_network_has_are_refused_before_they_are_read(stem, monkeypatch):
    monkeypatch.setattr(weights, "MAX_NUMBERS", 1000)
    with pytest.raises(ValueError, match="more than 1000 numbers are announced"):
        weights.load(stem)


def test_the_command_line_leaves_with_that_sentence_and_code_2(stem, capsys):
    truncated(NPZ)(stem)
    assert main(["evaluate", "--ckpt", str(stem)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"jprimfit: evaluate: {paths(stem)[NPZ]} cannot be used, it is damaged (")
    assert_one_sentence(err.removesuffix("\n"))


@pytest.mark.slow
def test_any_flipped_bit_is_noticed_or_harmless(model, stem, tmp_path):
    generator = np.random.default_rng(0)
    for number in range(400):
        copy = tmp_path / "copies" / "toy"
        copy.parent.mkdir(exist_ok=True)
        for source, target in zip(paths(stem), paths(copy), strict=True):
            shutil.copyfile(source, target)
        path = paths(copy)[number % 2]
        content = bytearray(path.read_bytes())
        bit = int(generator.integers(8 * len(content)))
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        try:
            found = weights.load(copy)
        except ValueError as error:
            assert_one_sentence(str(error))
            assert str(copy) in str(error)
            continue
        assert found.config == model.config and json.dumps(found.info) == json.dumps(model.info)
        jax.tree.map(np.testing.assert_array_equal, found.variables, model.variables)


def test_the_checksum_is_that_of_the_bare_numbers(model, stem):
    document = yaml.safe_load(paths(stem)[YAML].read_text())
    kernel = model.variables["params"]["shared"]["Dense_0"]["kernel"]
    assert document["arrays"][KERNEL] == f"float32 8x8 {hashlib.sha256(kernel.tobytes()).hexdigest()}"
