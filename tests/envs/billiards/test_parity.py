"""Random shots end as in Chipmunk at a fine step."""

import jax
import numpy as np
import pytest

from cuelearner_envs.billiards import Table, physics, simulate_many


@pytest.mark.parametrize("count", [15, pytest.param(40, marks=pytest.mark.long)])
def test_random_shots_end_as_in_chipmunk(monkeypatch, count):
    pytest.importorskip("pymunk")
    import pymunk_table as engine

    monkeypatch.setattr(physics, "BLOCK", 4)  # simulated in blocks, of which the last is filled up
    table = Table.regulation()
    places, angles = engine.scenes(table, count, seed=1)
    angles[::2] = np.arctan2(*(places[::2, 1] - places[::2, 0]).T[::-1])  # else few shots would move a target
    world = engine.PymunkTable(table, engine.FINE_STEP)
    theirs = [world.play(place, angle) for place, angle in zip(places, angles, strict=True)]
    ours = jax.jit(simulate_many)(table, places.astype("f4"), np.zeros((count, 4), bool), angles.astype("f4"))

    pocketed = np.array([gone for _, gone, _ in theirs])
    assert pocketed.any()
    agree = (pocketed == np.asarray(ours.pocketed)).all(1)
    assert agree.sum() >= count - 2  # 0.997 of 300 scenes agree
    distance = np.linalg.norm(np.array([place for place, _, _ in theirs]) - ours.positions, axis=-1)
    moved = np.linalg.norm(places - ours.positions, axis=-1) > 1e-3
    assert np.median(distance[agree[:, None] & ~pocketed & moved]) < 0.6e-3
    assert np.median(np.abs(np.array([duration for _, _, duration in theirs]) - ours.duration)[agree]) < 1e-3
