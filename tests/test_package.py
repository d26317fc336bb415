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


def test_no_network_is_shipped_yet():
    with pytest.raises(ValueError, match="no network is shipped yet, so 'default' cannot be loaded"):
        jprimfit.load_model("default")
