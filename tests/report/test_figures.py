"""What figures show: points on their ticks, a scale for what was learned, names that neither overlap nor cross."""

import itertools

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from cuelearner_jax.report.figures import draw_curves, draw_label_efficiency, names_of
from cuelearner_jax.report.statistics import Interval, curve
from cuelearner_jax.report.variants import Variant


def variant(guidance, labels, level, *, first=0.8, steps=11, spread=0.002):
    """Three seeds that begin at `first` and are near `level` ever after."""
    values = np.full((3, steps), level) + spread * np.array([[-1.0], [0.0], [1.0]])
    values[:, 0] = first
    known = curve(10_000 * np.arange(steps), values)
    last = Interval(*(row[-1] for row in known[1:]))
    return Variant(guidance, labels, np.arange(3), values, known, last, np.array([], int))


def names(figure, axes):
    """Boxes on the picture and texts of the curves' names, from the lowest up."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    found = [text for text in axes.texts if "interquartile" not in text.get_text()]
    return sorted(((text.get_window_extent(), text.get_text()) for text in found), key=lambda pair: pair[0].y0)


def test_points_stand_on_their_ticks():
    variants = [variant(kind, labels, 0.3) for kind in ("relative", "scalar") for labels in (100, 350, 500)]
    figure = draw_label_efficiency([variant("none", 0, 0.2), *variants], "title", "reward")
    for axes in figure.axes:
        ticks = axes.get_xticks().tolist()
        assert ticks == [100, 350, 500]
        drawn = [container[0].get_xdata() for container in axes.containers]
        assert len(drawn) == 2
        for labels in drawn:
            np.testing.assert_array_equal(labels, ticks)


def test_budgets_are_compared_at_a_step_that_all_have():
    rising = [variant("none", 0, 0.2), variant("relative", 100, 0.3), variant("relative", 500, 0.3)]
    rising[1].curve.estimate[-1] = 0.9  # after the step at which the other was stopped
    stopped = variant("heuristic", 0, 0.25, steps=9)
    left = draw_label_efficiency([*rising, stopped], "title", "reward").axes[0]
    assert left.get_title("left") == "at step 80,000, reached by all"
    np.testing.assert_allclose(left.containers[0][0].get_ydata(), [0.3, 0.3])


@pytest.mark.parametrize(("first", "left_out"), [(0.8, True), (0.05, False)])
def test_the_scale_is_that_of_what_was_learned(first, left_out):
    variants = [variant("none", 0, 0.05, first=first), variant("relative", 500, 0.02, first=first)]
    axes = draw_curves(variants, "title", "collision").axes[0]
    low, high = axes.get_ylim()
    assert 0.01 < low < 0.02
    assert 0.05 < high < 0.06
    note = next(text.get_text() for text in axes.texts if "interquartile" in text.get_text())
    assert ("step 0 (from 0.8 to 0.8) not on the scale" in note) == left_out


def test_a_start_that_belongs_to_the_picture_stays_in_it():
    """Success begins at 0: only where all else would be squeezed into a fifth is it left out."""
    axes = draw_curves([variant("none", 0, 0.2, first=0.0), variant("relative", 500, 0.9, first=0.0)], "t", "s").axes[0]
    assert axes.get_ylim()[0] < 0
    flat = draw_curves([variant("none", 0, 0.5, first=0.0, spread=0.0)], "t", "s").axes[0]
    assert flat.get_ylim()[0] < 0


def test_names_at_the_ends_neither_overlap_nor_cross():
    """Curves that end earlier and later, close to one another and one of them above all."""
    levels = {100: 0.011, 200: 0.0102, 300: 0.0101, 400: 0.0105, 500: 0.2}
    variants = [variant("relative", n, level, steps=11 - n // 100 % 2) for n, level in levels.items()]
    figure = draw_curves(variants, "title", "collision")
    axes = figure.axes[0]
    boxes = names(figure, axes)
    assert [text for _, text in boxes] == [f"relative, {n} labels" for n in sorted(levels, key=lambda n: levels[n])]
    assert all(lower.y1 <= upper.y0 + 1 for (lower, _), (upper, _) in itertools.pairwise(boxes))
    dotted = [np.asarray(line.get_data()) for line in axes.lines if line.get_linestyle() == ":"]
    heights = [y for x, y in dotted if x.tolist() == [1, 1.025]]
    assert len(heights) == len(levels)
    for one, other in itertools.combinations(heights, 2):
        assert np.prod(one - other) > 0


def test_many_names_shrink_rather_than_overlap():
    figure = draw_curves([variant("relative", 10 * n, 0.01 * n) for n in range(1, 31)], "title", "reward")
    boxes = names(figure, figure.axes[0])
    assert len(boxes) == 30
    assert all(lower.y1 <= upper.y0 + 1 for (lower, _), (upper, _) in itertools.pairwise(boxes))


def test_a_name_with_dollars_or_beyond_all_length_is_drawn():
    assert matplotlib.rcParams["text.parse_math"]  # what others draw is left as it is
    figure = draw_curves([variant("$\\broken{$" + "x" * 200, 0, 0.3)], "a $ b", "$x")
    ((_, text),) = names(figure, figure.axes[0])
    assert text.startswith("$\\broken{$xxx")
    assert len(text) <= 40


def test_of_budgets_too_near_each_other_the_larger_has_its_name():
    assert names_of([25, 100, 500, 1_000]) == ["25", "100", "500", "1,000"]
    assert names_of([25, 100, 500, 1_000, 10_000, 100_000]) == ["25", "100", "", "1,000", "10,000", "100,000"]
    assert (names_of([500]), names_of([])) == (["500"], [])
