"""The profile of a step: scopes of operations, own times of nested ones, and a real training step part by part."""

import pytest

from jprimfit.apps.main import main
from jprimfit.training import profile

PROGRAM = """
HloModule jit_step
%fused (p: f32[4]) -> f32[4] {
  ROOT %mul.1 = f32[4] multiply(%p, %p), metadata={op_name="jit(step)/jvp(Segmenter)/backbone/encoder_0/mul"}
}
ENTRY %main {
  %dot.1 = f32[4] dot(%a, %b), lhs_contracting_dims={1}
  %fusion.1 = f32[4] fusion(%dot.1), calls=%fused, metadata={op_name="jit(step)/jvp(Segmenter)/backbone/encoder_0/mul"}
  ROOT %copy.1 = f32[4] copy(%fusion.1)
}
"""


def event(operation, start, length, thread=1):
    return {"ph": "X", "pid": 1, "tid": thread, "ts": start, "dur": length, "args": {"hlo_op": operation}}


def test_nameless_operations_take_the_scope_of_their_neighbours():
    found = profile.scopes(PROGRAM)
    assert found["fusion.1"] == found["dot.1"] == found["copy.1"] == "jit(step)/jvp(Segmenter)/backbone/encoder_0/mul"


def test_operations_inside_others_count_once():
    scope_of = {
        "loop": "jit(step)/jvp(losses)/while",
        "step": "jit(step)/transpose(jvp(Segmenter))/backbone/backbone._decode/decoder_2_mlp/dot",
        "head": "jit(step)/jvp(Segmenter)/Segmenter._normals/normal_weight/add",
    }
    events = [event("loop", 0, 10), event("step", 2, 3), event("step", 6, 1), event("head", 10, 4), event("?", 3, 2, 7)]
    events.append({"ph": "M", "pid": 1, "name": "process_name", "args": {"name": "host"}})
    found = profile.shares(events, scope_of)
    assert list(found)[0] == "losses" and sum(map(sum, found.values())) == pytest.approx(1)
    assert found["losses"] == pytest.approx((6 / 16, 0)) and found["decoder 2"] == pytest.approx((0, 4 / 16))
    assert found["heads"] == pytest.approx((4 / 16, 0)) and found["other"] == pytest.approx((2 / 16, 0))


def test_a_trace_without_operations_is_refused():
    with pytest.raises(ValueError, match="name no operations"):
        profile.shares([{"ph": "M", "args": {}}], {})


def test_a_training_step_part_by_part(tmp_path, capsys):
    words = ["data.num_clouds=8", "validation.num_clouds=2", "train.batch_size=2", f"data.cache={tmp_path}"]
    assert main(["train", "--config", "configs/tiny.yaml", "--profile", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    shares = {line[:9].strip(): float(line[9:].split()[0]) for line in lines if " % " in line}
    assert {"encoder 0", "encoder 2", "decoder 0", "heads", "losses", "update", "inputs"} <= set(shares)
    assert sum(shares.values()) == pytest.approx(100, abs=1) and shares.get("other", 0) < 15
    assert "step of 2 clouds" in lines[-1] and "clouds/s" in lines[-1]
