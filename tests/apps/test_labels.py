"""Corrected segments: read from every form they come in, merged and retyped, refused in a sentence."""

import numpy as np
import pytest

from jprimfit.apps.labels import merged, read_labels, retyped
from jprimfit.apps.main import main
from jprimfit.io import ply, text
from jprimfit.scene import Scene

LABELS = np.array([0, 0, 1, -1, 2, 2])


def test_labels_come_back_from_every_form(tmp_path):
    points = np.random.default_rng(0).normal(size=(6, 3))
    ply.write_segments(tmp_path / "a.ply", points, points, np.zeros((6, 3), np.uint8), LABELS, np.zeros(6, np.int8))
    np.save(tmp_path / "a.npy", LABELS)
    np.savetxt(tmp_path / "a.txt", LABELS, fmt="%d")
    for name in ("a.ply", "a.npy", "a.txt"):
        np.testing.assert_array_equal(read_labels(tmp_path / name), LABELS, err_msg=name)


def test_a_property_as_cloudcompare_writes_it(tmp_path):
    rows = "\n".join(f"{i} 0 0 {label}.0" for i, label in enumerate(LABELS))
    header = "ply\nformat ascii 1.0\nelement vertex 6\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "scalar_label")
    )
    (tmp_path / "a.ply").write_text(f"{header}end_header\n{rows}\n")
    np.testing.assert_array_equal(read_labels(tmp_path / "a.ply"), LABELS)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("none.npy", None),
        ("a.npy", b"nothing"),
        ("a.txt", b"1\ntwo\n"),
        ("a.json", b"{}"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"),
    ],
)
def test_what_holds_no_labels_is_refused(name, content, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        read_labels(tmp_path / name)


def test_merging_and_retyping():
    np.testing.assert_array_equal(merged(LABELS, ["0,2"]), [0, 0, 1, -1, 0, 0])
    np.testing.assert_array_equal(merged(LABELS, ["2,0", "1,2"]), [1, 1, 1, -1, 1, 1])
    np.testing.assert_array_equal(merged(LABELS, []), LABELS)
    assert retyped(["5=cone", "0=plane"]) == {5: "cone", 0: "plane"}


@pytest.mark.parametrize("words", ["3", "a,b", "0,9", "-1,0", ""])
def test_merges_that_mean_nothing_are_refused(words):
    with pytest.raises(ValueError, match=f"--merge {words}"):
        merged(LABELS, [words])


@pytest.mark.parametrize("words", ["5", "cone=5", "5="])
def test_retypings_that_mean_nothing_are_refused(words):
    with pytest.raises(ValueError, match=f"--retype {words}"):
        retyped([words])


def test_an_answer_is_corrected_and_fitted_again(tmp_path, capsys):
    """A cylinder whose halves were told apart: merged, and then made a plane against all evidence."""
    generator = np.random.default_rng(0)
    angle, height = generator.uniform(0, 2 * np.pi, 900), generator.uniform(0, 2, 900)
    points = np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    text.write(tmp_path / "part.xyz", points)
    np.save(tmp_path / "halves.npy", (angle > np.pi).astype(int))
    words = ["fit", str(tmp_path / "part.xyz"), "--labels", str(tmp_path / "halves.npy"), "--quiet"]
    assert main([*words, "--out", str(tmp_path / "two")]) == 0
    two = Scene.load(tmp_path / "two" / "scene.json")
    assert [primitive.kind for primitive in two.primitives] == ["cylinder"] * 2 and len(set(two.surface_of)) == 1
    assert main([*words, "--merge", "0,1", "--out", str(tmp_path / "one")]) == 0
    one = Scene.load(tmp_path / "one" / "scene.json")
    assert len(one.primitives) == 1 and one.report["settings"]["labels"] is True
    np.testing.assert_allclose(one.primitives[0].radius, 1.0, atol=1e-5)
    words[3] = str(tmp_path / "one" / "scene.json")
    assert main([*words, "--retype", "0=plane", "--out", str(tmp_path / "flat")]) == 0
    assert Scene.load(tmp_path / "flat" / "scene.json").primitives[0].kind == "plane"
    assert main([*words, "--retype", "0=torus", "--out", str(tmp_path / "no")]) == 2
    assert "torus" in capsys.readouterr().err and not (tmp_path / "no").exists()
    assert main([*words[:2], "--retype", "0=plane", "--out", str(tmp_path / "no")]) == 2
    assert "--labels" in capsys.readouterr().err
