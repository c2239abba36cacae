"""What figures show: a panel a kind and a setting, and names in the order of the curves."""

from dataclasses import replace

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from cuelearner_jax.report.figures import draw_curves
from cuelearner_jax.report.variants import Variant


def variant(guidance, labels, level, *, first=0.8, steps=11, spread=0.002):
    """Three seeds that begin at `first` and are near `level` ever after."""
    values = np.full((3, steps), level) + spread * np.array([[-1.0], [0.0], [1.0]])
    values[:, 0] = first
    return Variant(guidance, labels, np.arange(3), 10_000 * np.arange(steps), values)


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_more_than_four_variants_have_a_panel_a_kind_where_equal_curves_have_other_dashes():
    variants = [variant(kind, labels, 0.3) for kind in ("relative", "scalar") for labels in (100, 500)]
    figure = draw_curves([variant("none", 0, 0.3), *variants], "title", "reward")
    kinds = [legend(axes) for axes in figure.axes]
    assert kinds[0] == ["no guidance", "relative, 100 labels", "relative, 500 labels"]
    assert kinds[1] == ["no guidance", "scalar, 100 labels", "scalar, 500 labels"]
    for axes in figure.axes:
        assert len({str(line._dash_pattern) for line in axes.lines}) == 3
        assert min(line.zorder for line in axes.lines) > max(band.zorder for band in axes.collections)


def test_panels_of_settings_carry_their_names_and_no_name_is_cut():
    setting = "scalars.eps_deg={},scalars.refined_fraction=0.5"
    kinds = [("none", 0, 0.1), ("relative", 100, 0.3), ("relative", 500, 0.2)]
    variants = [replace(variant(*kind), run=setting.format(eps)) for eps in (2, 5) for kind in kinds]
    for axes, eps in zip(draw_curves(variants, "title", "reward").axes, (2, 5), strict=True):
        assert axes.get_title(loc="left").replace("\n", " ") == setting.format(eps).replace(",", ", ")
        assert legend(axes) == ["relative, 100 labels", "relative, 500 labels", "no guidance"]


def test_curves_are_named_in_the_order_of_their_ends_whatever_their_names_hold():
    assert matplotlib.rcParams["text.parse_math"]  # what others draw is left as it is
    variants = [variant("$\\broken{$", 0, 0.1), variant("relative", 100, 0.3), variant("relative", 500, 0.2)]
    figure = draw_curves(variants, "a $ b", "$x")
    FigureCanvasAgg(figure).draw()
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["relative, 100 labels", "relative, 500 labels", "$\\broken{$"]
