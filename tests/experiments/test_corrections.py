"""The study of corrections alone: what its data say, its arithmetic, and the page that is made of what was recorded."""

import importlib
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from cuelearner_jax.guides import registry

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data" / "corrections_alone"
PAGE = ROOT / "docs" / "results" / "corrections.md"


def imported(name):
    sys.path.insert(0, str(ROOT / "experiments"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(ROOT / "experiments"))


@pytest.fixture(scope="module")
def study():
    return imported("corrections_alone")


@pytest.fixture(scope="module")
def page():
    return imported("corrections_page")


def test_every_kind_compares_as_many_settings(study):
    for world in study.EPS:
        for kind in set(study.KINDS[world]) - {"base", "reading"}:
            settings = study.settings_of(world, kind)
            assert len({tuple(one.items()) for one in settings}) == (8 if world in study.FITTED else 4), (world, kind)
    for world, chosen in study.CHOSEN.items():
        assert set(chosen) <= set(study.KINDS[world])


def test_the_peers_are_in_every_world_and_reading_where_a_change_is_named(study):
    for world, kinds in study.KINDS.items():
        assert {"base", "relative", "demonstration", "scalar", "dcoach", "bdcoach", "clic"} <= set(kinds)
        assert ("reading" in kinds) == study.WORLDS[world].adapts


def test_one_cue_a_label_means_nothing_where_there_is_one_cue(study):
    corrections = imported("_corrections")
    one = next(condition for condition in study.CONDITIONS if condition.name == "one")
    plain = study.CONDITIONS[0]
    clic, shown = registry.find("clic"), registry.find("clic_shown")
    assert [corrections.means(cues, one, clic) for cues in (1, 3)] == [False, True]
    assert not corrections.means(3, one, shown)
    assert corrections.means(1, plain, shown)


def test_the_grasp_that_is_best_is_held_and_the_middle_of_the_box_seldom(study):
    corrections = imported("_corrections")
    env = corrections.Grasp()
    keys = jax.random.split(jax.random.key(0), 200)
    _, obs = jax.vmap(env.reset)(keys)
    best = jax.vmap(env.best)(obs)
    np.testing.assert_array_equal(corrections.GRIP.retract(best), best)  # within the box
    held = jax.vmap(lambda obs, action: env.step(keys[0], obs, action)[1].reward)
    assert held(obs, best).all()
    assert held(obs, jax.vmap(env.heuristic)(obs)).mean() < 0.1


def test_labels_that_match_the_reference_are_read_between_budgets(page):
    """100 labels of the reference reach 0.6; the kind passes it halfway from 25 to 100, on the logarithm: at 50."""
    reference = page.Curve((25, 100, 250), np.array([[0.3, 0.6, 0.9]] * 4))
    kind = page.Curve((25, 100, 250), np.array([[0.4, 0.8, 0.9]] * 4))
    (low, high), (lower, upper) = page.ratio(kind, reference)
    np.testing.assert_allclose([low, high, lower, upper], 0.5, rtol=1e-6)
    slow = page.Curve((25, 100, 250), np.array([[0.0, 0.1, 0.2]] * 4))
    assert page.ratio_words(page.ratio(slow, reference)) == "above 2.50 [2.50, no bound]"
    fast = page.Curve((25, 100, 250), np.array([[0.7, 0.8, 0.9]] * 4))
    assert page.ratio_words(page.ratio(fast, reference)) == "below 0.25 [0.00, 0.25]"


def test_a_condition_that_was_interrupted_is_measured_anew(study):
    def rows(condition, *cells):
        return [{"condition": condition, "seed": seed, "labels": labels} for seed, labels in cells]

    plain = rows("plain", (0, 25), (0, 100), (1, 25), (1, 100))
    assert study.whole([*plain, *rows("wrong", (0, 25), (0, 100), (1, 25))], seeds=2) == plain
    assert study.whole(rows("one", (0, 25), (0, 100)), seeds=2) == []
