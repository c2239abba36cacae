"""Runs of which lanes fail: they go on, name them, mark them and leave them out; and end with status 1."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

import cuelearner_jax as cl
from cuelearner_jax.cli import dispatch
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.runs import lanes, policy_sources
from cuelearner_jax.runs.grid import Grid, load
from cuelearner_jax.runs.order import Order
from cuelearner_jax.storage import results
from cuelearner_jax.studies import evaluate, train

CONFIG = probes.config(
    sizes={"feedback_layers": (8,), "fit_steps": 20, "lanes_per_block": 3},
    schedule={"total_steps": 48, "eval_every": 16, "checkpoint_every": 16, "eval_steps": 10},
    agent={"q_layers": (8, 8), "replay_capacity": 40},
)
GRID = Grid(("none",), seeds=(3, 5, 8), labels=())
TASK = probes.make_task()


def order(out, **options):
    return Order(TASK, CONFIG, GRID, out, **options)


def sickened(start):
    """Seed 5 begins with weights whose products are beyond float32."""

    def made(group):
        blocks = []
        for block in start(group):
            wrong = jnp.where(jnp.asarray(group.seeds) == 5, 1e30, 1.0)
            scaled = lambda leaf, wrong=wrong: leaf * wrong.reshape(3, *[1] * (leaf.ndim - 1))  # noqa: E731
            blocks.append(block.replace(agent=block.agent.replace(params=jax.tree.map(scaled, block.agent.params))))
        return blocks

    return made


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """Two folders: of a sweep whose seed 5 fails, and of one that nothing befell; and what the first one told."""
    base = tmp_path_factory.mktemp("failing")
    train.run(order(base / "healthy"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes.LaneGroup, "start", sickened(lanes.LaneGroup.start))
        told = []
        patch.setattr("cuelearner_jax.runs.runner.console", type("Told", (), {"print": staticmethod(told.append)}))
        with pytest.raises(NotFinite) as raised:
            train.run(order(base / "sick"))
    return base / "sick", base / "healthy", told, str(raised.value)


def test_the_failed_lane_is_named_while_it_runs_and_at_the_end(ended):
    _, _, told, last = ended
    assert told == ["none: seed 5 no longer finite at step 16: kept at the last finite state, marked as failed"]
    assert last.startswith("1 of 3 lanes failed, no longer finite (none: seed 5 (by step 16)): their rows in ")


def test_its_rows_are_marked_and_the_others_are_what_they_would_be(ended):
    sick, healthy, *_ = ended
    rows, others = (results.read(folder).to_pylist() for folder in (sick, healthy))
    assert len(rows) == len(others) == 3 * 4
    for row, other in zip(rows, others, strict=True):
        lost = row["seed"] == 5 and row["step"] > 0
        assert (row["failed"], other["failed"]) == (float(lost), 0.0)
        if lost:
            assert [row[name] for name in ("reward", "hit", "train_loss", "train_reward")] == [None] * 4
        elif row["seed"] != 5:
            for name in ("reward", "hit", "train_loss", "train_reward", "guide_reward"):
                assert row.get(name) == other.get(name), name


def test_the_same_is_said_by_every_resume_and_nothing_is_changed(ended):
    sick, _, _, last = ended
    before = probes.files_of(sick)
    with pytest.raises(NotFinite) as again:
        train.run(order(sick, resume=True))
    assert str(again.value) == last
    assert probes.files_of(sick) == before


def test_evaluation_leaves_it_out_and_says_so(ended, capsys):
    sick, healthy, *_ = ended
    found = []
    for folder in (sick, healthy):
        _, config, grid = load(folder, {TASK.name: TASK}.__getitem__)
        source = policy_sources.PolicySource(TASK, config, grid, folder)
        found += evaluate.run(source, evaluate.EvaluateRequest(task=config.task, envs=10, steps=10))
        (block,) = source.load()
        np.testing.assert_array_equal(block.failed, [False, folder == sick, False])
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(block.policy["params"]))
    assert [row.seeds.tolist() for row in found] == [[3, 8], [3, 5, 8]]
    np.testing.assert_array_equal(found[0].metrics["reward"], found[1].metrics["reward"][[0, 2]])
    assert "none: seed 5 failed, no longer finite: left out" in capsys.readouterr().err
    source = policy_sources.PolicySource(TASK, CONFIG, GRID, sick)
    for seed, says in ((3, ""), (5, "seed 5 failed, no longer finite: this is its last finite state\n")):
        policy_sources.LaneChoice(guidance="none", seed=(seed,)).lane_in(source, CONFIG.task)
        assert capsys.readouterr().err == says


def test_status_one_and_one_line(ended, capsys, monkeypatch):
    monkeypatch.setattr(dispatch, "_dispatch", lambda arguments: train.run(order(ended[0], resume=True)))
    assert dispatch.main(["sweep"]) == 1
    assert capsys.readouterr().err.strip().splitlines()[-1] == ended[3]


def test_diverging_from_the_command_line_and_from_python(tmp_path):
    """Every lane, by a learning rate as a user would give it."""
    wild = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, learning_rate=1e9))
    grid = Grid(("none",), seeds=(3, 5, 8), labels=())
    with pytest.raises(NotFinite, match="3 of 3 lanes failed"):
        train.run(Order(TASK, wild, grid, tmp_path / "run"))
    _, config, grid = load(tmp_path / "run", {TASK.name: TASK}.__getitem__)
    source = policy_sources.PolicySource(TASK, config, grid, tmp_path / "run")
    with pytest.raises(UserError, match="all of these lanes failed"):
        evaluate.run(source, evaluate.EvaluateRequest(task=config.task, envs=10, steps=10))
    with pytest.warns(UserWarning, match=r"3 of 3 lanes failed, no longer finite .*: leave out the rows"):
        found = cl.train(
            cl.World(TASK, probes.WindowConfig()), None, wild, guidance=("none",), seeds=(3, 5, 8), progress=False
        ).results
    assert [(row["failed"], row["reward"]) for row in found.slice(found.num_rows - 3).to_pylist()] == [(1.0, None)] * 3
