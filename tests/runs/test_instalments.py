"""Labels in instalments: who has been asked for how many, runs that go on in the middle, the guides' own quality."""

from contextlib import contextmanager

import numpy as np
import probes
import pytest
from small_runs import stopping_at

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import order, runner, sweep
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.instalments import Instalments
from cuelearner_jax.runs.order import Order
from cuelearner_jax.storage import guides, label_files, results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.terminal import Interrupted

CONFIG = probes.config(
    sizes={"q_layers": (8,), "feedback_layers": (8,), "lanes_per_block": 1, "fit_steps": 20, "replay_capacity": 40},
    scalars={"ask_bound_deg": 30.0},
    schedule={"total_steps": 64, "guidance_until": 48, "checkpoint_every": 32, "ask_at": (0, 32)}
    | {"guide_eval_every": 10},
)
GRID = Grid(("relative",), seeds=(3,), labels=(25, 40))
TASK = probes.make_task()
VOLATILE = ("wall_s", "commit", "command", "folder")


# Counting.


def counted(budgets, schedule=None, **sizes):
    config = probes.config(sizes=sizes, schedule={"ask_at": (0, 16), **(schedule or {})})
    return Instalments(np.array(budgets, np.int32), config.sizes, config.schedule)


def test_lanes_begin_instalments_together_and_wait_for_each_other():
    found = counted([25, 40, 100])
    assert [found.end(i) for i in range(2)] == [5, 10]
    assert [found.asked(n).tolist() for n in (0, 1, 2, 3, 5, 6, 10)] == [
        [0, 0, 0],
        [10, 10, 10],
        [20, 20, 20],
        [20, 20, 30],
        [20, 20, 50],
        [25, 30, 60],
        [25, 40, 100],
    ]
    assert [found.begun(step) for step in (0, 15, 16, 40)] == [0, 0, 1, 1]
    assert [found.next_step(step) for step in (0, 15, 16, 40)] == [16, 16, 48, 48]


def test_an_instalment_is_as_long_as_its_longest_share_which_need_not_be_the_largest_budgets():
    # In five instalments 7 rounds are 2, 1, 2, 1, 1 and 8 rounds 2, 2, 1, 2, 1.
    found = counted([70, 80], {"ask_at": (0, 16, 32, 48, 64)})
    assert [found.end(i) for i in range(5)] == [2, 4, 6, 8, 9]
    asked = np.array([found.asked(n) for n in range(found.rounds + 1)])
    assert asked[-1].tolist() == [70, 80]
    assert (np.diff(asked, axis=0) >= 0).all()
    assert np.diff(asked, axis=0).max() == 10


def test_one_instalment_is_the_whole_budget():
    found = counted([5, 35], {"ask_at": (0,)})
    assert found.rounds == 4
    assert [found.asked(n).tolist() for n in range(5)] == [[0, 0], [5, 10], [5, 20], [5, 30], [5, 35]]
    assert [found.examined(n, n - 1).tolist() for n in range(1, 5)] == [
        [True, False],
        *[[False] * 2] * 2,
        [False, True],
    ]


def test_budgets_too_small_for_their_instalments_and_labels_of_files_are_refused(tmp_path):
    few = Order(TASK, CONFIG, Grid(("relative", "none"), (3,), (40, 10)), tmp_path / "run")
    with pytest.raises(UserError, match=r"10 labels are no 2 instalments of whole rounds .*give --labels above 10"):
        order.planned(few)
    order.planned(Order(TASK, CONFIG, Grid(("none",), (3,), ()), tmp_path / "run"))  # nobody is asked
    with pytest.raises(UserError, match="--labels-from gives all labels before the first step"):
        order.planned(Order(TASK, CONFIG, GRID, tmp_path / "run", labels_from=tmp_path / "labels.parquet"))


# Runs.


@contextmanager
def killed_instead_of_save(when):
    """A kill in place of the given checkpoint."""

    class Killed(Exception):
        pass

    saves, usual = [], runner.Runner._save

    def save(self, saved):
        saves.append(self.training.round)
        if len(saves) == when:
            raise Killed
        usual(self, saved)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner.Runner, "_save", save)
        patch.setattr(runner, "ROUNDS_A_CHUNK", 1)
        with pytest.raises(Killed):
            yield


def run(out, **options):
    sweep.run(Order(TASK, CONFIG, GRID, out, **options))


def rows(table):
    return table.drop_columns([name for name in VOLATILE if name in table.column_names]).to_pylist()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing disturbed: rounds 1 and 2, 32 steps, rounds 3 and 4, 32 steps."""
    out = tmp_path_factory.mktemp("whole") / "run"
    run(out)
    return out


def test_the_guides_own_quality_is_a_row_each_time_a_lane_has_ten_labels_more(whole):
    table = guides.read_guides(whole)
    assert table is not None
    found = sorted((row["labels"], row["asked"], row["step"], row["round"]) for row in table.to_pylist())
    small, large = [(20, 0, 2), (25, 32, 3)], [(20, 0, 2), (30, 32, 3), (40, 32, 4)]
    assert found == sorted(
        [(25, 10, 0, 1), *((25, *row) for row in small), (40, 10, 0, 1), *((40, *row) for row in large)]
    )
    assert not (whole / "relative" / guides.JSONL).exists()
    told = {row["labels"]: row["guide_reward"] for row in results.read(whole).to_pylist() if row["step"] == 0}
    at_first = {row["labels"]: row["guide_reward"] for row in table.to_pylist() if row["asked"] == 20}
    assert told == at_first  # the same measurement
    names = {"run", "task", "guidance", "split", "config_hash", "hardware", "failed", "guide_hit"}
    assert names <= set(table.column_names)


def test_budgets_are_exact_and_labels_of_earlier_instalments_stay(whole):
    file = label_files.read(whole / "relative" / label_files.PARQUET)
    assert len(file.seeds) == 40  # every answer counts, and none is past the budget


def assert_same_run(out, whole):
    assert rows(results.read(out)) == rows(results.read(whole))
    assert rows(guides.read_guides(out)) == rows(guides.read_guides(whole))
    mine, theirs = (label_files.read(folder / "relative" / label_files.PARQUET).labels for folder in (out, whole))
    np.testing.assert_array_equal(mine.action, theirs.action)


def test_a_run_goes_on_from_the_end_of_an_instalment_that_no_checkpoint_tells_of(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(4), pytest.raises(Interrupted, match="stopped at step 32"):  # before the second one
        run(out)
    with killed_instead_of_save(2):  # its last round was asked and its row written
        run(out, resume=True)
    assert max(tables.read(out / "relative" / guides.JSONL, guides.SCHEMA)["round"].to_pylist()) == 4
    assert not (out / "relative" / label_files.PARQUET).exists()
    run(out, resume=True)
    assert_same_run(out, whole)


def test_a_run_goes_on_from_the_middle_of_an_instalment_and_misses_rows_that_were_lost(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(5), pytest.raises(Interrupted, match="stopped at step 32"):
        run(out)
    file = out / "relative" / guides.JSONL
    told = file.read_text()
    file.write_text("".join(told.splitlines(keepends=True)[:-2]))
    with pytest.raises(UserError, match="lacks rows: 1, the first of seed 3 with 40 labels after 30 of them"):
        run(out, resume=True)
    file.write_text(told)
    run(out, resume=True)
    assert_same_run(out, whole)


def test_runs_that_ask_nothing_have_no_table_of_guides(tmp_path):
    (tmp_path / "old").mkdir()
    assert guides.read_guides(tmp_path / "old") is None
    with pytest.raises(UserError, match="does not exist"):
        guides.read_guides(tmp_path / "nothing")
