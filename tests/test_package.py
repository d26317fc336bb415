"""The package itself: importing it costs nothing, its names are found when used, what is not built says so."""

import subprocess
import sys

import pytest

import jprimfit


def test_importing_and_help_load_no_jax():
    code = (
        "import sys, jprimfit\nfrom jprimfit.apps.main import main\n"
        "for words in (['--help'], ['fit', '--help'], ['demo', '--help'], ['--version']):\n"
        "    try: main(words)\n    except SystemExit as stop: assert stop.code == 0\n"
        "print('jax' in sys.modules, 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False False"


def test_names_are_found_when_used():
    assert jprimfit.Scene.__module__ == "jprimfit.scene"
    assert jprimfit.Cone.kind == "cone"
    assert {"fit", "Scene", "load_model", "Plane"} <= set(dir(jprimfit))
    with pytest.raises(AttributeError, match="has no attribute 'torus'"):
        _ = jprimfit.torus


def test_a_model_that_is_not_there_is_named_in_one_sentence(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path} holds no model: two files .* are expected there.$"):
        jprimfit.load_model(tmp_path)
    with pytest.raises(ValueError, match="^'nonesuch' is no model: give default or spfn"):
        jprimfit.load_model("nonesuch")


def test_a_shipped_model_that_is_absent_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr("jprimfit.networks.weights.ASSETS", tmp_path)
    with pytest.raises(ValueError, match="^the model 'default' is not shipped with .* fit without a network.$"):
        jprimfit.load_model("default")


def test_loading_a_model_brings_in_no_training_library():
    code = (
        "import sys, jprimfit\n"
        "try: jprimfit.load_model('nonesuch')\nexcept ValueError: pass\n"
        "print({'orbax', 'optax', 'chex', 'trimesh', 'manifold3d'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
