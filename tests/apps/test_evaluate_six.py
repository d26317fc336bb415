"""`jprimfit evaluate` with the six metrics: from the command line to tables and JSON, and what it refuses."""

import json
import shutil
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.apps.main import main
from jprimfit.data import native
from jprimfit.data.records import Cloud, Part
from jprimfit.evaluation import test_set
from jprimfit.geometry.hierarchy import HierarchySpec, from_index_sets
from jprimfit.geometry.preparation import prepare
from jprimfit.networks import weights
from jprimfit.networks.pointconv import PointConvConfig
from jprimfit.networks.segmenter import Segmenter, SegmenterConfig
from jprimfit.types import Plane, Sphere

SIX = ("miou", "type_accuracy", "normal_deg", "axis_deg", "residual", "p_coverage")
POINTS = ("--points", "128")


def make_part(seed, *, split="test"):
    """A plane and a sphere: with a fake pipeline that knows both, in the frame of the points."""
    draw = np.random.default_rng(seed)
    flat = np.append(draw.uniform(-1, 1, (200, 2)), np.zeros((200, 1)), axis=1)
    ball = draw.normal(size=(100, 3))
    ball /= np.sqrt(np.sum(ball**2, axis=1, keepdims=True))
    up = np.array([0.0, 0.0, 1.0])
    cloud = Cloud(
        np.concatenate([flat, 0.2 * ball + 0.5 * up]),
        np.concatenate([np.tile(up, (200, 1)), ball]),
        np.repeat([0, 1], [200, 100]).astype(np.int32),
    )
    primitives = (Plane(up, np.float64(0.0)), Sphere(0.5 * up, np.float64(0.2)))
    return Part(f"{split} {seed}", primitives, cloud=cloud, areas=np.array([4.0, 0.16]), split=split, family=split)


@pytest.fixture(scope="module")
def parts_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "parts.h5"
    native.write(path, [*(make_part(seed) for seed in range(3)), make_part(7, split="val")])
    return path


@pytest.fixture(scope="module")
def ckpt(tmp_path_factory):
    """The folder of an untrained network for 128 points."""
    spec = HierarchySpec((16,), (8,), (4,), (8,), (0.2,), (0.1,), (2.0,))
    narrow = PointConvConfig(encoder=((8, 8),), decoder=((8, 8),), weight_channels=4)
    config = SegmenterConfig(hierarchy=spec, pointconv=narrow, num_points=128, num_slots=8, shared=8)
    points = make_part(0).cloud.points[::2][:128].astype(np.float32)
    ready = jax.tree.map(jnp.asarray, prepare(points, spec=spec, neighborhoods=(16,)))
    hierarchy = from_index_sets(ready.points, ready.sets, ready.mask)
    inputs = (ready.points, hierarchy, ready.local_normals, ready.curvature)
    variables = jax.device_get(jax.jit(Segmenter(config).init)(jax.random.key(0), *inputs))
    folder = tmp_path_factory.mktemp("model")
    weights.save(folder / "weights", weights.Model(config, variables, "tiny", {}))
    return folder


def test_geometry_alone_end_to_end_without_learning(parts_file, quick, tmp_path, capsys):
    """The fake pipeline says plane and sphere in turns."""
    goal = tmp_path / "scores.json"
    words = ["--method", "geometry", "--data", str(parts_file), *POINTS, "--json", str(goal)]
    assert main(["evaluate", *words]) == 0
    assert len(quick) == 3 and all(call["model"] is None for call in quick)
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].split()[:3] == ["method", "mIoU", "%"] and lines[2].startswith("geometry alone")
    assert lines[-1].startswith("3 parts of split test") and "128 points each, uniform noise of 0.01" in lines[-1]
    assert "mIoU" in err
    scores = json.loads(goal.read_text())
    assert [part["name"] for part in scores["parts"]] == ["test 0", "test 1", "test 2"]
    assert set(SIX) <= set(scores["mean"]) and set(SIX) <= set(scores["parts"][0])
    for name in SIX:
        there = [part[name] for part in scores["parts"] if part[name] is not None]
        assert scores["mean"][name] == pytest.approx(np.mean(there))
        assert scores["standard_error"][name] >= 0
    assert 0 < scores["mean"]["miou"] < 1 and scores["parts"][0]["seconds"] is None
    assert scores["groups"]["cylinder"]["count"] == 0 and scores["groups"]["cylinder"]["mean"]["miou"] is None
    assert scores["groups"]["plane"]["count"] == scores["groups"]["small"]["count"] == 3
    assert scores["method"] == "geometry" and scores["ckpt"] is None and scores["points"] == 128


def test_network_refinement_and_geometry_on_the_same_clouds(parts_file, quick, ckpt, tmp_path, capsys):
    goal = tmp_path / "scores.json"
    words = ["--compare", "--ckpt", str(ckpt), "--data", str(parts_file), "--parts", "2", "--noise", "1"]
    assert main(["evaluate", *words, *POINTS, "--json", str(goal)]) == 0
    names = ["network", "network + refinement", "geometry alone"]
    out = capsys.readouterr().out
    assert [line.split("  ")[0] for line in out.splitlines()[2:5]] == names
    assert "noise of 1 % of the diagonal" in out
    models = [call["model"] for call in quick]
    assert [model and model.name for model in models] == ["tiny", "tiny", None, None]
    np.testing.assert_array_equal(quick[0]["points"], quick[2]["points"])
    scores = json.loads(goal.read_text())
    assert list(scores["methods"]) == ["network", "refined", "geometry"] and scores["method"] == "network"
    assert scores["mean"] == scores["methods"]["network"]["mean"] and len(scores["parts"]) == 2
    assert scores["methods"]["refined"]["mean"]["miou"] == scores["methods"]["geometry"]["mean"]["miou"]
    assert scores["noise_percent"] == 1 and scores["ckpt"] == str(ckpt)


def test_table_1_sets_networks_beside_geometry_and_ransac(parts_file, quick, ckpt, tmp_path, capsys):
    goal, other = tmp_path / "scores.json", tmp_path / "other"
    shutil.copytree(ckpt, other)
    words = ["--table", "1", "--ckpt", str(ckpt), str(other), "--data", str(parts_file), "--parts", "2"]
    assert main(["evaluate", *words, "--points", "300", "--json", str(goal)]) == 0
    methods = json.loads(goal.read_text())["methods"]
    networks = [f"{one} {answer}" for answer in ("network", "refined") for one in (ckpt, other)]
    assert list(methods) == [*networks, "geometry", "ransac", "refitted"]
    first, second = (methods[name]["mean"] for name in networks[:2])
    assert {name: first[name] for name in SIX} == {name: second[name] for name in SIX}  # they are the same network
    by_family = capsys.readouterr().out.split("mIoU % / type %")[1]
    assert by_family.splitlines()[2].split("  ")[0] == methods["geometry"]["parts"][0]["family"]
    assert f"{100 * methods['geometry']['mean']['miou']:.1f}" in by_family


def test_without_data_the_test_set_is_built_once(parts_file, quick, monkeypatch, tmp_path, capsys):
    built = []

    def build(path, config, *, workers, progress):
        built.append(config)
        path.write_bytes(parts_file.read_bytes())
        progress(1)
        return Counter()

    monkeypatch.setenv("JPRIMFIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(test_set, "build", build)
    words = ["evaluate", "--method", "geometry", "--every", "2", *POINTS]
    assert main(words) == 0
    assert f"building the test set of 330 parts of unseen families, once, in {tmp_path / 'cache'}" in (
        capsys.readouterr().err
    )
    assert main(words) == 0
    assert "building" not in capsys.readouterr().err
    assert len(built) == 1 and built[0].test >= 300 and built[0].train == built[0].val == 0
    assert len(quick) == 4


def test_the_test_set_needs_what_builds_solids(monkeypatch, tmp_path, capsys):
    def build(*_, **__):
        raise ModuleNotFoundError("No module named 'manifold3d'", name="manifold3d")

    monkeypatch.setenv("JPRIMFIT_CACHE", str(tmp_path))
    monkeypatch.setattr(test_set, "build", build)
    assert main(["evaluate", "--method", "geometry"]) == 2
    assert "manifold3d, which is not installed" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--split", "none"], "has no split 'none'; it has test, val"),
        (["--parts", "0"], "1 part or more"),
        (["--points", "3"], "128 points or more"),
        (["--noise", "-1"], "a noise of 0 or more"),
        (["--every", "0"], "a step of 1 or more"),
        (["--json", "nowhere/scores.json"], "there is no folder nowhere"),
        (["--rotate"], "--rotate, --thin and --outliers belong to --protocol fit4cad"),
        (["--thin", "30"], "--rotate, --thin and --outliers belong to --protocol fit4cad"),
        (["--compare"], "--method geometry takes no network"),
        (["--method", "ransac", "--ckpt", "default"], "--method ransac takes no network"),
        (["--no-refine"], "--method geometry has nothing to refine"),
        (["--method", "cpfn"], "--method cpfn is not built yet"),
        (["--method", "magic"], "--method 'magic' is none"),
        (["--table", "1"], "--table 1 compares all methods"),
        (["--table", "timing"], "--table timing is not built yet"),
        (["--protocol", "fit4cad", "--data", "absent.h5"], "absent.h5"),
    ],
)
def test_what_cannot_be_meant_is_one_sentence(parts_file, capsys, words, sentence):
    assert main(["evaluate", "--method", "geometry", "--data", str(parts_file), *POINTS, *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and sentence in err and len(err.splitlines()) == 1


def test_absent_models_and_foreign_files_are_named(parts_file, tmp_path, capsys):
    assert main(["evaluate", "--ckpt", str(tmp_path), "--data", str(parts_file)]) == 2
    assert "holds no model" in capsys.readouterr().err
    foreign = tmp_path / "text.h5"
    foreign.write_text("nothing")
    assert main(["evaluate", "--method", "geometry", "--data", str(foreign)]) == 2
    assert str(foreign) in capsys.readouterr().err
    assert main(["evaluate", "--method", "geometry", "--protocol", "fit4cad"]) == 2
    assert "needs --data FILE" in capsys.readouterr().err


def test_help_tells_what_is_measured(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--help"])
    out = capsys.readouterr().out
    assert stop.value.code == 0
    for words in ("--ckpt DIR", "--compare", "--[no-]refine", "--noise P", "mIoU", "examples:", "P % of the diagonal"):
        assert words in out or words in out.replace("--refine, --no-refine", "--[no-]refine")


def test_ransac_is_scored_with_its_own_fits_and_with_ours(parts_file, tmp_path):
    goal = tmp_path / "ransac.json"
    words = ["--data", str(parts_file), "--points", "300", "--method", "ransac", "--refine", "--noise", "0"]
    assert main(["evaluate", *words, "--ransac", "default", "--json", str(goal)]) == 0
    methods = json.loads(goal.read_text())["methods"]
    assert list(methods) == ["ransac", "refitted"]
    for scores in methods.values():
        assert len(scores["parts"]) >= 1
        assert all(0 <= part["miou"] <= 1 and part["seconds"] != 0 for part in scores["parts"])
