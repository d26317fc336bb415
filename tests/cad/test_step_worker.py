"""A file that kills OpenCASCADE, or keeps it for ever, costs one sentence; the next file is read."""

import os
from pathlib import Path

import numpy as np
import pytest

from jprimfit.cad import step, step_reader, step_worker


@pytest.fixture
def box(tmp_path):
    pytest.importorskip("OCP")
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer

    with step.quiet():
        writer = STEPControl_Writer()
        writer.Transfer(BRepPrimAPI_MakeBox(1.0, 2.0, 3.0).Shape(), STEPControl_StepModelType.STEPControl_AsIs)
        writer.Write(str(tmp_path / "box.step"))
    return tmp_path / "box.step"


def test_files_are_read_and_refused_one_after_the_other(box, tmp_path, capfd):
    text = box.read_text()
    broken = tmp_path / "broken.step"
    broken.write_text("\n".join(line for line in text.splitlines() if "CARTESIAN_POINT" not in line))
    (tmp_path / "text.step").write_text("Dear Sir,")
    with step_worker.Reader() as reader:
        for path in (tmp_path / "text.step", broken, tmp_path / "absent.step"):
            with pytest.raises(ValueError, match=path.name) as caught:
                reader.read(path)
            assert "\n" not in str(caught.value)
            found = reader.read(box)
            np.testing.assert_array_equal(found.bodies[0].areas, step_reader.read_step(box).bodies[0].areas)
    assert capfd.readouterr().out == ""


def test_a_process_that_dies_costs_one_file(tmp_path):
    pytest.importorskip("OCP")
    path = tmp_path / "some.step"
    # A wrong call, which is no ValueError, ends the process as a crash would.
    with step_worker.Reader(os._exit) as reader:
        for _ in range(2):
            with pytest.raises(ValueError, match=r"some\.step cannot be read: OpenCASCADE crashed on it"):
                reader.read(path)


def test_a_file_that_takes_for_ever_is_given_up(tmp_path):
    pytest.importorskip("OCP")
    path = tmp_path / "pipe.step"
    os.mkfifo(path)  # whoever reads it waits for a writer
    with step_worker.Reader(Path.read_bytes, limit=0.2) as reader, pytest.raises(ValueError, match="more than 0.2 s"):
        reader.read(path)


def test_without_opencascade(monkeypatch, tmp_path):
    monkeypatch.setattr(step, "available", lambda: False)
    with step_worker.Reader() as reader, pytest.raises(ValueError, match=r"pip install 'jprimfit\[cad\]'"):
        reader.read(tmp_path / "some.step")
