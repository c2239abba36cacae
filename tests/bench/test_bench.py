"""Counting operations, what a measurement compares with, and the stored table of known machines."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import pytest
from probes import CONFIG, Window, compilations, make_task

from cuelearner_jax.actions import DIRECTIONS
from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.networks import applied, q_network
from cuelearner_jax.bench import known_machines as machines
from cuelearner_jax.bench import measuring as bench
from cuelearner_jax.bench.flops import forward, forward_and_backward, step_operations
from cuelearner_jax.config import Sizes
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.task import Preset
from cuelearner_jax.tasks.billiards import BILLIARDS
from cuelearner_jax.types import Transition

LAYERS, OBS = (64, 48), 10
SPACES = Spaces(OBS, DIRECTIONS)
WIDTHS = (OBS, DIRECTIONS.size)
Q = applied(q_network(LAYERS))


def test_operations_are_those_counted_by_hand():
    # Two numbers of an action and ten of an observation to 64, 64 to 48, 48 to 1: weights 128, 640, 3072, 48.
    assert forward(LAYERS, WIDTHS, 1) == 2 * (640 + 128 + 3072 + 48)
    assert forward(LAYERS, WIDTHS, 5) == 2 * 640 + 5 * 2 * (128 + 3072 + 48)
    # Weights' gradients of all layers; inputs' of all but the first.
    assert forward_and_backward(LAYERS, WIDTHS) == 2 * 3888 + 2 * 3888 + 2 * 3120
    sizes = Sizes(q_layers=LAYERS, directions=36, target_directions=12, batch_size=7, updates_per_step=2)
    one_step = step_operations(sizes, SPACES, bootstraps=False)
    assert one_step == (2 * 640 + 36 * 2 * 3248, 2 * 7 * (4 * 3888 + 2 * 3120), 0)
    assert one_step.total == 235136 + 305088
    target = 2 * 640 + 12 * 2 * 3248 + 2 * 3888
    assert step_operations(sizes, SPACES, bootstraps=True).targets == 2 * 7 * target
    with_return = dataclasses.replace(sizes, n_step=30)
    assert step_operations(with_return, SPACES, bootstraps=True).targets == 2 * 2 * 7 * target
    assert step_operations(with_return, SPACES, bootstraps=False).targets == 0


def test_the_paper_s_argmax_costs_4_5_gflop_a_step():
    paper = BILLIARDS.presets["paper"].config
    full = dataclasses.replace(paper.sizes, coarse_directions=0)
    counted = step_operations(full, Spaces(12, DIRECTIONS), paper.bootstraps)
    assert counted.acting == 2 * (12 * 400 + 3600 * (2 * 400 + 2 * 160_000 + 120_000 + 2 * 90_000 + 300))
    assert counted.targets == 0


def traced_operations(function, *arguments):
    """XLA's own count, of the program before a backend's library calls, whose operations it does not know."""
    return jax.jit(function).lower(*arguments).cost_analysis()["flops"]


def test_operations_are_those_that_xla_counts():
    params = q_network(LAYERS).init(jax.random.key(0), jnp.zeros(OBS), jnp.zeros(2))
    directions, batch = jnp.ones((72, 2)), 32
    items = Transition(*(jnp.ones((batch, *shape)) for shape in ((OBS,), (2,), (), (), (OBS,))))
    acting = traced_operations(lambda p, obs: ddqn.greedy(Q, p, obs, directions), params, jnp.ones(OBS))
    assert acting == pytest.approx(forward(LAYERS, WIDTHS, 72), rel=0.05)
    loss = jax.value_and_grad(lambda p: ddqn.loss(Q, p, items, items.reward))
    gradient = traced_operations(loss, params)
    assert gradient == pytest.approx(batch * forward_and_backward(LAYERS, WIDTHS), rel=0.05)
    other = jax.tree.map(lambda leaf: leaf + 1, params)
    target = partial(ddqn.target, Q, params, other, options=directions, discount=0.9)
    targets = traced_operations(jax.vmap(target), items)
    assert targets == pytest.approx(batch * (forward(LAYERS, WIDTHS, 72) + forward(LAYERS, WIDTHS, 1)), rel=0.05)


@pytest.fixture(scope="module")
def work():
    config = dataclasses.replace(CONFIG, sizes=dataclasses.replace(CONFIG.sizes, lanes_per_block=4))
    task = dataclasses.replace(make_task(), presets={"small": Preset("", CONFIG)})
    return bench.Work(task, "small", config)


@pytest.fixture(scope="module")
def row(work):
    return bench.measure(work, 3, lane_mesh(), seconds=0.01)


@pytest.mark.long
def test_a_row_s_figures_agree_with_each_other(work, row):
    assert set(row) == set(machines.ROW)
    assert row["steps_a_second"] == pytest.approx(3 * 1e3 / row["ms_a_step"])
    assert row["ms_an_iteration"] == pytest.approx(4 * row["ms_a_step"])
    operations = step_operations(work.config.sizes, Spaces(2, DIRECTIONS), bootstraps=False).total
    assert row["mflop_a_step"] == pytest.approx(operations / 1e6)
    assert row["gflops"] == pytest.approx(row["steps_a_second"] * operations / 1e9)
    assert row["share_of_matmul"]["float32"] == pytest.approx(row["gflops"] / row["matmul_gflops"]["float32"])
    # Replay keeps 4,000 rows of 5 numbers; the networks, Adam's two averages and the rest are small beside it.
    assert 0.08 < row["mb_a_seed"] < 0.11
    assert row["stretches"] >= 3
    assert row["first_step_s"] > 0
    assert row["changed"] == {"sizes.lanes_per_block": 4}


def test_timed_lanes_learn_and_compile_once():
    timed = bench.Timed(bench.learning(CONFIG), Window(), "none", 2)
    assert [timed.train(3) > 0 for _ in range(2)] == [True, True]
    assert int(timed.clock.step) == int(timed.clock.update) == 2 * 3 * CONFIG.sizes.num_envs
    assert compilations(timed.group.program.train) == [1]


def test_stretches_shrink_with_the_work_and_are_powers_of_two():
    few, many, most = (bench.iterations_of(CONFIG, Spaces(2, DIRECTIONS), seeds) for seeds in (1, 1000, 10**9))
    assert (few, most) == (256, 1)  # 1,024 steps of four environments; at least one iteration
    assert 1 < many < 256
    assert many.bit_count() == 1


def entry_of(row, **values):
    text = {name: "x" for name, kind in machines.ENTRY.items() if kind is str}
    return {**text, "cores": 2, "rows": [row], **values}


def test_known_machines_stand_beside_what_was_measured(row):
    known = [entry_of({**row, "steps_a_second": rate}, name=name) for name, rate in (("a", 50.0), ("a", 200.0))]
    known.append(entry_of({**row, "seeds": 9}, name="b"))
    told = machines.beside(entry_of({**row, "steps_a_second": 100.0}), known)
    assert told.splitlines()[2].split() == ["window", "small*", "3", "200", "(0.50x)", "-"]  # the newest of a name
    assert "no machine is known" in machines.beside(entry_of(row), [])


def test_networks_that_cost_something_else_are_not_compared(row):
    told = machines.beside(entry_of(row), [entry_of({**row, "mflop_a_step": 2 * row["mflop_a_step"]}, name="a")])
    assert "x)" not in told


def test_the_shipped_table_is_whole_and_traceable():
    for entry in machines.read():
        assert len(entry["commit"]) == 12, entry["commit"]
        assert entry["command"].startswith("cuelearner bench")
        assert "jax " in entry["versions"]
        assert set(entry) == set(machines.ENTRY)
        for row in entry["rows"]:
            assert set(row) == set(machines.ROW)
            assert 0 < row["share_of_matmul"]["float32"] < 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"commit": ""}, "commit is empty"),
        ({"commit": "0123456789ab-dirty"}, "uncommitted changes"),
        ({"cores": "two"}, "cores is missing or of the wrong type"),
        ({"rows": []}, "no rows"),
        ({"rows": [{"task": "window"}]}, "preset is missing"),
    ],
)
def test_what_is_no_measurement_stays_out_of_the_table(row, tmp_path, change, says):
    table, file = tmp_path / "machines.json", tmp_path / "entry.json"
    table.write_text("[]")
    file.write_text(json.dumps(entry_of(row, **change)))
    with pytest.raises(UserError, match=says):
        machines.add(file, table)
    assert table.read_text() == "[]"


def test_a_measurement_is_taken_into_the_table_once(row, tmp_path):
    table, file = tmp_path / "machines.json", tmp_path / "entry.json"
    table.write_text("[]")
    file.write_text(json.dumps(entry_of(row)))
    machines.add(file, table)
    assert machines.read(table) == [entry_of(row)]
    with pytest.raises(UserError, match="already"):
        machines.add(file, table)
    with pytest.raises(UserError, match="cannot be read"):
        machines.add(tmp_path / "nowhere.json", table)
