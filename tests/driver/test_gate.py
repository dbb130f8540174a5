"""What of a torque may leave: numbers, within the limits of torque and torque rate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from salver.driver.gate import Gate

NAN = float("nan")


@pytest.mark.slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.lists(st.floats() | st.just(NAN), min_size=1, max_size=4), max_size=12), st.floats())
def test_only_numbers_within_the_limits_pass_the_gate(wanted: list[list[float]], start: float) -> None:
    limit, rate, period = np.array([87.0, 12.0, np.inf]), np.array([1000.0, np.inf, 10.0]), 1e-3
    gate = Gate(-limit, limit, rate, period, np.full(3, start))
    last = gate(np.full(3, NAN))
    for torque in wanted:
        sent = gate(np.array(torque))
        assert np.all(np.isfinite(sent))
        assert np.all(np.abs(sent) <= limit)
        assert np.all(np.abs(sent - last) <= rate * period + 1e-12 * np.abs(last))
        last = sent


def test_the_gate_lets_through_what_is_within_the_limits() -> None:
    gate = Gate(np.full(2, -10.0), np.full(2, 10.0), np.full(2, 1000.0), 1e-3, np.array([1.0, -1.0]))
    assert gate(np.array([1.5, -1.9])).tolist() == [1.5, -1.9]
    assert gate(np.array([4.0, NAN])).tolist() == [2.5, -1.9]  # a step of 1 N m; what it had
    assert (gate.cut, gate.closed) == (1, 1)
