"""The curve of a run: one line per write, none twice after a resume, none half."""

import json
import os

import jax.numpy as jnp
import numpy as np

from jprimfit.training.writer import NAME, Writer, read


def write_curve(folder, steps, **options):
    with Writer(folder, **options) as writer:
        for step in steps:
            writer.write(step, "train", {"total": 1.0 / step})
            writer.write(step, "validation", {"miou": step / 10})


def test_a_line_per_write_on_disk_at_once(tmp_path):
    with Writer(tmp_path / "new" / "run") as writer:
        writer.write(5, "train", {"total": jnp.float32(0.5), "rate": np.float64(1e-3), "lost": float("nan")})
        text = (tmp_path / "new" / "run" / NAME).read_text()
    assert json.loads(text) == {"step": 5, "kind": "train", "total": 0.5, "rate": 1e-3, "lost": None}
    assert text.endswith("}\n") and text.count("\n") == 1


def test_a_resume_cuts_what_lies_beyond_its_checkpoint(tmp_path):
    write_curve(tmp_path, (1, 2, 3, 4))
    write_curve(tmp_path, (3, 4, 5), resumed_step=2)
    lines = read(tmp_path)
    assert [(line["step"], line["kind"]) for line in lines] == [
        (step, kind) for step in (1, 2, 3, 4, 5) for kind in ("train", "validation")
    ]


def test_a_new_run_begins_a_new_curve(tmp_path):
    write_curve(tmp_path, (1, 2))
    write_curve(tmp_path, (7,))
    assert [line["step"] for line in read(tmp_path)] == [7, 7]


def test_a_half_written_line_is_dropped_and_nothing_is_glued_to_it(tmp_path):
    write_curve(tmp_path, (1, 2))
    size = (tmp_path / NAME).stat().st_size
    os.truncate(tmp_path / NAME, size - 7)
    assert [line["step"] for line in read(tmp_path)] == [1, 1, 2]
    write_curve(tmp_path, (3,), resumed_step=2)
    assert [line["step"] for line in read(tmp_path)] == [1, 1, 2, 3, 3]
    assert all(json.loads(line) for line in (tmp_path / NAME).read_text().splitlines())


def test_foreign_lines_are_no_metrics(tmp_path):
    (tmp_path / NAME).write_bytes(b'\xff\xfe{\n[1, 2]\n{"step": "x"}\nnull\n{"step": 3, "kind": "train"}\n')
    assert read(tmp_path) == [{"step": 3, "kind": "train"}]
    assert read(tmp_path / "absent") == []


def test_no_other_process_writes(tmp_path, monkeypatch):
    monkeypatch.setattr("jprimfit.training.writer.jax.process_index", lambda: 1)
    write_curve(tmp_path, (1, 2), tensorboard=True)
    assert list(tmp_path.iterdir()) == []


def test_tensorboard_gets_a_file_per_start(tmp_path):
    write_curve(tmp_path, (1, 2), tensorboard=True)
    write_curve(tmp_path, (2, 3), resumed_step=1, tensorboard=True)
    first, second = sorted((tmp_path / "tensorboard").iterdir(), key=lambda path: path.stat().st_mtime_ns)
    for path in (first, second):
        content = path.read_bytes()
        assert path.name.startswith("events.out.tfevents.") and b"brain.Event:2" in content
        assert content.count(b"train/total") == content.count(b"validation/miou") == 2
