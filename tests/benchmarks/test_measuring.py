"""Measuring a machine: figures that agree with each other, of lanes that learn from the first step."""

import _measuring
import pytest
from probes import CONFIG, Window


def test_a_row_s_figures_agree_with_each_other():
    row = _measuring.measure_training(CONFIG, Window, 3, seconds=0.01)
    assert row["steps_a_second"] == pytest.approx(3 * 1e3 / row["ms_a_step"])
    # Replay keeps 4,000 rows of 5 numbers; the networks, Adam's two averages and the rest are small beside it.
    assert 0.08 < row["mb_a_seed"] < 0.11
    assert row["stretches"] >= 3
    assert row["first_step_s"] > 0
    assert row["spread"] >= 0
