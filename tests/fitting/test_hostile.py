"""Whatever is given to fit_primitive, it answers in finite numbers or refuses in one sentence."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jprimfit
from jprimfit.fitting import associations, single
from jprimfit.primitives.table import KINDS, MODULES

COUNTS = (0, 1, 2, 3, 6, 40, 200)  # all are padded to one shape
ODD = (0.0, -0.0, 1.0, -1.0, 1e-300, -1e-320, 1e-8, 1e8, 1e99, 1e101, 1e308, np.inf, -np.inf, np.nan)


@st.composite
def arrays(draw, shape):
    """Numbers of a shape and any scale: noise, a grid, a few values over and over; odd values strewn in."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["noise", "grid", "few values", "flat", "line"]))
    values = {
        "noise": lambda: rng.normal(size=shape),
        "grid": lambda: rng.integers(-2, 3, shape).astype(float),
        "few values": lambda: rng.choice(draw(st.lists(st.sampled_from(ODD[:7]), min_size=1, max_size=3)), shape),
        "flat": lambda: rng.normal(size=shape) * np.resize([1.0, 1.0, 0.0], shape[-1]),
        "line": lambda: rng.normal(size=(shape[0], *[1] * (len(shape) - 1))) * np.ones(shape),
    }[kind]()
    values = values * 10.0 ** draw(st.sampled_from([0, 0, 0, -200, -7, 7, 90])) + draw(st.sampled_from([0.0, 0.0, 1e6]))
    if values.size and draw(st.booleans()) and draw(st.booleans()):
        values.flat[rng.integers(0, values.size, 3)] = draw(st.sampled_from(ODD))
    with np.errstate(over="ignore"):
        return values.astype(draw(st.sampled_from([np.float64, np.float64, np.float32])))


@st.composite
def calls(draw):
    """Arguments of fit_primitive, most of them of shapes that fit together."""
    count = draw(st.sampled_from(COUNTS))
    other = draw(st.sampled_from([count, count, count, count, count, 5]))
    weights = draw(st.one_of(st.none(), arrays((other,)).map(np.abs), arrays((other,))))
    normals = draw(st.one_of(st.none(), arrays((other, 3))))
    method = draw(st.sampled_from([*single.METHODS, "best", "best", "best"]))
    return (draw(st.sampled_from(KINDS)), draw(arrays((count, 3))), weights, normals), method, draw(st.booleans())


def answered(call):
    arguments, method, robust = call
    try:
        found, info = jprimfit.fit_primitive(*arguments, method=method, robust=robust)
    except ValueError as error:
        assert str(error).endswith(".") and "\n" not in str(error)
        return
    assert all(np.all(np.isfinite(field)) for field in found)
    assert np.isfinite(info.rms) and np.isfinite(info.sigma) and np.all(np.isfinite(info.anchor))
    assert not np.any(np.isnan(info.covariance)) and info.covariance.shape == (MODULES[arguments[0]].NUM_FREEDOM,) * 2
    if info.ok and method not in associations.METHODS:
        assert np.all(np.linalg.eigvalsh(np.nan_to_num(info.covariance)) >= -1e-6 * np.abs(info.covariance).max())


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(calls())
def test_hostile_input_is_answered_or_refused(call):
    answered(call)


@pytest.mark.slow
@settings(max_examples=10_000, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(calls())
def test_ten_thousand_hostile_inputs(call):
    answered(call)
