"""Policies adapted on the command line: a run's, code's and adapted ones, in folders that every command takes."""

import json
import shutil
import traceback
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_house import ROW

import cuelearner_jax as cl
from cuelearner_jax.cli import main
from cuelearner_jax.guides import base
from cuelearner_jax.storage import formats
from cuelearner_jax.studies.adapt import AdaptRequest
from cuelearner_jax.tasks import registry

NAME = "own_turned"
OWN = '''
import dataclasses
import jax.numpy as jnp, numpy as np, probes
from cuelearner_jax.task import Body, Preset, Scenario, Task

@dataclasses.dataclass(frozen=True)
class Config:
    half_width_deg: float = 8.0
    """Half the width of the winning window [deg]."""
    offset_deg: float = 0.0
    """Where the best direction lies from what is seen [deg]."""

def environment(config, split):
    return probes.Window(*jnp.deg2rad(jnp.array([config.half_width_deg, config.offset_deg])))

CONFIG = dataclasses.replace(probes.CONFIG, task=Config())
TASK = Task(
    "turned", "a bandit", Config, (Body("point", "", environment),), teacher=lambda config, env: probes.Expert(env),
    presets={"small": Preset("seconds", CONFIG, labels=(10,))},
    scenarios={
        "aslant": Scenario("the best direction is turned", {"offset_deg": -20.0}, bound_deg=45.0, eps_deg=5.0),
        "told": Scenario(
            "how is said too", {"offset_deg": 20.0}, guidance="demonstration", judge_by="labels",
            sizes={"labels_per_round": 40, "frame": "raw"}, scalars={"k_max": 7},
        ),
        "ruled": Scenario(
            "all is said", {"offset_deg": 20.0}, bound_deg=28.0, eps_deg=4.0, guidance="demonstration", judge_by="hit",
            judge_bounds=(0.5,), scalars={"k_max": 7},
            sizes={"labels_per_round": 20, "feedback_layers": (16,), "fit_steps": 40, "frame": "action"},
        ),
        "tried": Scenario("bounds are tried", {"offset_deg": 20.0}, judge_bounds=(0.5, 0.25)),
    },
)

def straight(obs):
    return obs.copy()

def failing(obs):
    raise RuntimeError("out of ink")
'''
TASK = ["--task", "own_turned:TASK"]
FIT = ["--guidance", "relative", "--sizes.feedback-layers", "32", "--sizes.fit-steps", "200"]
FIT += ["--sizes.fit-batch-size", "32", "--scalars.feedback-learning-rate", "0.005"]
AGAIN = [*TASK, "--base", "own_turned:straight"]  # the policy folder's code, as it is named again
CODE = ["adapt", "own_turned:straight", *TASK, "--scenario", "aslant", *FIT, "--judge-episodes", "20"]
EVALUATE = ["--steps", "2000", "--envs", "20"]  # as many as are judged on, so that one program does both
ANGLES = np.linspace(0, 6, 40, dtype=np.float32)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)


pytestmark = pytest.mark.usefixtures("there")


@pytest.fixture
def adapted(home, forget):
    """A Python function adapted to the changed world, with two budgets and two bounds."""
    out = home / "adapted"
    if not out.exists():
        lanes = ["--labels", "20", "80", "--bound-deg", "3", "45"]
        assert main([*CODE, *lanes, "--scalars.eps-deg", "3", "--scalars.tau-deg", "0.1", "--out", str(out)]) == 0
        forget()
    return out


def measured(tmp_path, *command):
    out = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
    assert main(["evaluate", *map(str, command), *EVALUATE, "--out", str(out)]) == 0
    return json.loads(out.read_text())["rows"]


def test_a_function_is_adapted_and_its_folder_evaluated(adapted, tmp_path):
    values = json.loads((adapted / "policy.json").read_text())
    assert values["task"]["offset_deg"] == -20.0
    assert values["of"] == {"code": "own_turned:straight"}
    assert values["judged"]["rewarded_steps"] == [2 * 20 * 100] * 4
    assert values["policy"]["base"] == {"policy": "code", "named": "own_turned:straight"}
    rows = measured(tmp_path, adapted, *AGAIN)
    assert [(row["labels"], row["bound_deg"]) for row in rows] == [(20, 3.0), (80, 3.0), (20, 45.0), (80, 45.0)]
    rewards = [row["reward"][0] for row in rows]
    assert rewards[:2] == [0.0, 0.0]  # 17 of 20 degrees off
    assert rewards[3] == 1.0
    (before,) = {row["reward"][0] for row in measured(tmp_path, adapted, *AGAIN, "--policy", "base")}
    assert before == 0.0


def test_a_scenario_says_how_unless_another_kind_or_judge_is_asked_for():
    task = registry.resolve("own_turned:TASK")

    def usual(**chosen):
        found = AdaptRequest.of(task, task.start(), **chosen)
        return found.guidance, found.judge_by, found.sizes.labels_per_round, found.scalars.k_max, found.judge_bounds

    assert usual(scenario="told") == ("demonstration", "labels", 40, 7, ())
    assert usual() == ("reading", "labels", 10, 50, ())
    assert usual(scenario="told", guidance="dcoach") == ("dcoach", "labels", 10, 50, ())
    assert usual(scenario="tried", guidance="relative")[-1] == (0.5, 0.25)
    assert usual(scenario="tried", guidance="relative", judge_by="labels")[-1] == ()


@pytest.mark.long
def test_lanes_of_a_run_are_adapted_one_each_and_again(home, tmp_path):
    run, out, chain = home / "run", tmp_path / "out", tmp_path / "chain"
    sweep = ["sweep", "own_turned:TASK", "--guidance", "none", "--seeds", "2", "--schedule.total-steps", "960"]
    assert main([*sweep, "--schedule.eval-every", "960", "--schedule.checkpoint-every", "960", "--out", str(run)]) == 0
    adapt = ["adapt", str(run), "--scenario", "aslant", *FIT, "--labels", "40", "--judge-episodes", "20"]
    assert main([*adapt, "--base.seed", "1", "0", "--out", str(out)]) == 0
    values = json.loads((out / "policy.json").read_text())
    assert (values["lanes"]["seeds"], values["lanes"]["base"], values["rows"]) == ([1, 0], [0, 1], 2)
    assert values["of"] == {"folder": "run", "guidance": "none", "labels": 0, "policy": "agent", "seeds": [1, 0]}
    (row,) = measured(tmp_path, out)
    (alone,) = measured(tmp_path, run, "--scenario", "aslant")
    (base,) = measured(tmp_path, out, "--policy", "base")
    assert row["seeds"] == base["seeds"] == alone["seeds"][::-1] == [1, 0]
    assert base["reward"] == alone["reward"][::-1]
    assert np.mean(row["reward"]) > np.mean(base["reward"])
    np.testing.assert_array_equal(cl.load_policy(out, policy="base", seed=0)(SEEN), cl.load_policy(run, seed=0)(SEEN))
    assert main([*["adapt", str(out), *FIT, "--labels", "10"], "--base.seed", "0", "--out", str(chain)]) == 0
    np.testing.assert_array_equal(cl.load_policy(chain, policy="base")(SEEN), cl.load_policy(out, seed=0)(SEEN))


def test_the_traceback_of_a_policy_that_fails_stands_below_the_line(tmp_path, capsys):
    assert main(["adapt", "own_turned:failing", *TASK, "--out", str(tmp_path / "new")]) == 2
    first, *below = capsys.readouterr().err.splitlines()
    assert first == "error: policy failing raised RuntimeError: out of ink: mend it first"
    assert any("own_turned.py" in line for line in below)
    assert below[-1] == "RuntimeError: out of ink"


def test_what_cannot_be_is_refused(adapted, forget, refused, tmp_path, capsys):
    new = ["--out", tmp_path / "new"]
    refused(["adapt", "own_turned:straight", *new], "needs a task to act in: give one, for instance --task", tmp_path)
    plain = ["adapt", "own_turned:straight", *TASK, *new, "--guidance", "relative"]
    refused([*plain, "--labels", "0"], "a label budget of 0 teaches nothing", tmp_path)
    refused([*plain, "--judge-by", "hits"], "not a metric of turned, did you mean 'hit'", tmp_path)
    refused([*plain, "--judge-bounds", "0.5", "--judge-by", "labels"], "judge_bounds needs episodes", tmp_path)
    refused(["adapt", "shipped:arm", "--judge-by", "distance", *new], "of which less is better", tmp_path)
    (tmp_path / "policy.onnx").touch()
    refused(["adapt", tmp_path / "policy.onnx", *TASK, *new], "policy.onnx", tmp_path)
    refused([*plain, "--base.seed", "3"], "leave out the options that choose a lane", tmp_path)
    refused([*CODE, "--out", adapted], "is not empty: give --overwrite", adapted)
    refused([*CODE, "--out", adapted.parent, "--overwrite"], "is not a policy folder", adapted)
    refused(["evaluate", adapted, *TASK], "add --base own_turned:straight if you trust that code", adapted)
    refused(["evaluate", adapted, *AGAIN, "--policy", "agent"], "needs a trained run", adapted)
    forget()
    refused(["evaluate", adapted], "add --task own_turned:TASK if you trust that code", adapted)
    load = partial(cl.load_policy, task="own_turned:TASK", base=lambda obs: obs)
    with pytest.raises(cl.UserError, match=r"no lane with seed 0 and 80 labels within 7 degrees.*3, 45 degrees"):
        load(adapted, bound_deg=7.0)
    mixed = tmp_path / "mixed"
    shutil.copytree(adapted, mixed)
    told = json.loads((mixed / "policy.json").read_text())
    load(mixed)
    assert "relative, 80 labels, seed 0: of 4 lanes the first with most labels and bound" in capsys.readouterr().err
    values = {name: value for name, value in told.items() if name not in ("format", "digest")}
    formats.write("policy", mixed / "policy.json", {**values, "arrays": "0" * len(told["arrays"])})
    with pytest.raises(cl.UserError, match="holds the arrays of another policy"):
        load(mixed)
    formats.write("policy", mixed / "policy.json", {**values, "robot": "legs"})
    with pytest.raises(cl.UserError, match="has no robots to choose from"):  # it is read
        load(mixed)


def test_the_way_from_the_command_line_to_the_fit_is_short(tmp_path, monkeypatch):
    way = []

    def fit(*arguments, **options):
        for frame in traceback.extract_stack():
            package, _, module = frame.filename.rpartition("/cuelearner_jax/")
            if package and way[-1:] != [module]:
                way.append(module)
        raise cl.UserError("enough")

    monkeypatch.setattr(base, "fit_model", fit)
    assert main([*CODE, "--labels", "20", "--out", str(tmp_path / "new")]) == 2
    rows = [ROW[Path(module).parts[0].removesuffix(".py")] for module in way]
    assert len({*way}) <= 11
    assert sum(above < below for above, below in pairwise(rows)) <= 3
