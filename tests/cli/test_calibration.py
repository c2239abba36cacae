"""Calibration on the command line and from Python: one folder, one result, and the user's own changes named again."""

import importlib
import json
import sys

import chex
import jax.numpy as jnp
import numpy as np
import pytest
from small_runs import next_command

import cuelearner_jax as cl
from cuelearner_jax.cli import main
from cuelearner_jax.policies import describe
from cuelearner_jax.spaces.directions import rotate
from cuelearner_jax.storage import label_files, results
from cuelearner_jax.tasks import registry

OWN = '''
import dataclasses
import jax.numpy as jnp, probes
from cuelearner_jax import Distortion, Unknown
from cuelearner_jax.spaces.directions import rotate
from cuelearner_jax.task import Body, Preset, Scenario, Task

@dataclasses.dataclass(frozen=True)
class Config:
    offset_deg: float = 0.0
    """Where the best direction lies from what is seen [deg]."""

def environment(config, split):
    return probes.Window(*jnp.deg2rad(jnp.array([8.0, config.offset_deg])), contexts=12)

TASK = Task(
    "askew", "a bandit", Config, (Body("point", "", environment),), teacher=lambda config, env: probes.Expert(env),
    presets={"small": Preset("seconds", dataclasses.replace(probes.CONFIG, task=Config()), labels=(10,))},
    scenarios={"aslant": Scenario("turned", {"offset_deg": -20.0}, bound_deg=45.0, eps_deg=5.0, judge_by="hit")},
)

def straight(obs):
    return obs.copy()

TWIST = Distortion(
    "twist", (Unknown("twist: angle", "degrees", scale=10.0),), lambda theta, obs: rotate(obs, -jnp.deg2rad(theta[0])))

def changes(env):
    return [TWIST]

WRONG = TWIST._replace(sees=lambda theta, obs: obs + 0.1)
'''
TASK = ["--task", "own_askew:TASK"]
ASK = ["adapt", "own_askew:straight", *TASK, "--scenario", "aslant", "--guidance", "calibration", "--labels", "20"]
ANGLES = np.linspace(0, 6, 12, dtype=np.float32)
SEEN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)
TURNED = np.asarray(rotate(jnp.asarray(SEEN), jnp.deg2rad(-20.0)))


def forget():
    registry._registered.clear()
    sys.modules.pop("own_askew", None)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("askew")
    (folder / "own_askew.py").write_text(OWN)
    return folder


@pytest.fixture(autouse=True)
def there(home, monkeypatch):
    """In the folder of the file, in a process that has not met the task."""
    monkeypatch.chdir(home)
    monkeypatch.setattr(sys, "path", [str(home), *sys.path])
    forget()
    yield
    forget()


@pytest.fixture
def calibrated(home):
    out = home / "calibrated"
    if not out.exists():
        assert main([*ASK, "--out", str(out)]) == 0
        forget()
    return out


def own():
    return importlib.import_module("own_askew")


def apart_deg(one, other):
    return np.degrees(np.arccos(np.clip((np.asarray(one) * other).sum(-1), -1, 1))).max()


def test_python_calibrates_as_the_command_does(calibrated, tmp_path):
    world = cl.make("own_askew:TASK", scenario="aslant")
    better = cl.adapt(own().straight, world, cl.teacher_of(world), labels=20, guidance="calibration")
    assert (better.used, better.rewarded_steps, better.judged[0]) == (True, 0, "labels")
    (turn,) = better.estimates
    assert (turn.name, turn.unit, turn.changed) == ("direction: turn", "degrees", True)
    assert turn.low < 20 < turn.high  # what is executed lies so far beside what is meant
    assert apart_deg(better(SEEN), TURNED) < 4
    better.save(tmp_path / "python")
    told = [json.loads((folder / "policy.json").read_text()) for folder in (calibrated, tmp_path / "python")]
    for values in told:
        del values["command"], values["digest"]
    assert told[0] == told[1]  # with the digest of the arrays
    assert told[0]["calibration"][0]["estimates"][0]["mean"] == turn.mean
    chex.assert_trees_all_equal(
        *(label_files.read(f / "labels.parquet").labels for f in (calibrated, tmp_path / "python"))
    )
    loaded = cl.load_policy(calibrated, task="own_askew:TASK", base=own().straight)
    np.testing.assert_array_equal(loaded(SEEN), better(SEEN))
    (change,) = describe(loaded.policy)["changes"]
    assert (change["name"], change["unit"]) == ("direction: turn", "degrees")
    assert change["value"] == pytest.approx(turn.mean, rel=1e-6)


def test_a_calibrated_folder_is_compared_with_its_base(calibrated, tmp_path):
    out = tmp_path / "measured.json"
    command = ["evaluate", str(calibrated), *TASK, "--base", "own_askew:straight", "--compare", "base"]
    assert main([*command, "--steps", "400", "--envs", "20", "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["guidance"], row["labels"], row["reward"]) == ("calibration", 20, [1.0])
    assert "bound_deg" not in row or row["bound_deg"] is None


@pytest.mark.long
def test_labels_of_a_file_are_read_once_and_serve_models_too(calibrated, tmp_path):
    """The same file, without a question: the same change, and a model of another kind."""
    ask = [*ASK, "--labels-from", str(calibrated), "--out"]
    assert main([*ask, str(tmp_path / "again")]) == 0
    again = cl.load_policy(tmp_path / "again", task="own_askew:TASK", base=own().straight)
    assert apart_deg(again(SEEN), TURNED) < 4
    relative = ["--guidance", "relative", "--judge-by", "labels", "--sizes.fit-steps", "20"]
    forget()
    assert main([*ASK[:6], *relative, "--labels-from", str(calibrated), "--out", str(tmp_path / "model")]) == 0
    assert json.loads((tmp_path / "model" / "policy.json").read_text())["policy"]["guidance"] == "relative"


def test_seeds_and_budgets_are_lanes_and_rewards_may_judge(calibrated, tmp_path, capsys):
    out = tmp_path / "lanes"
    lanes = ["--labels", "10", "20", "--seeds", "2"]
    judged = ["--judge-by", "hit", "--judge-episodes", "10", "--judge-every", "10"]
    assert main([*ASK[:-2], *lanes, *judged, "--out", str(out)]) == 0
    values = json.loads((out / "policy.json").read_text())
    assert (values["lanes"]["labels"], values["lanes"]["seeds"]) == ([10, 10, 20, 20], [0, 1, 0, 1])
    assert values["judged"]["rewarded_steps"] == [2 * 10 * 100] * 4
    assert values["judged"]["before"] == [0.0] * 4
    assert (
        "20 labels, seed 1: hit on tuning episodes 0 before, 1 after (2,000 rewarded steps)" in capsys.readouterr().out
    )
    curve = results.read_guides([out])
    assert curve is not None
    rows = {(row["labels"], row["seed"], row["asked"]): row["guide_hit"] for row in curve.to_pylist()}
    assert {asked for labels, _, asked in rows if labels == 20} == {0, 10, 20}
    assert (rows[20, 0, 0], rows[20, 0, 20]) == (0.0, 1.0)
    alone = cl.load_policy(calibrated, task="own_askew:TASK", base=own().straight)
    lane = cl.load_policy(out, task="own_askew:TASK", base=own().straight, labels=20, seed=0)
    np.testing.assert_array_equal(lane(SEEN), alone(SEEN))  # whatever else runs beside


@pytest.mark.long
def test_several_agents_are_calibrated_each_with_its_seed_and_again(home, tmp_path):
    run, out, again = home / "run", tmp_path / "out", tmp_path / "again"
    sweep = ["sweep", "own_askew:TASK", "--guidance", "none", "--seeds", "2", "--schedule.total-steps", "960"]
    assert main([*sweep, "--schedule.eval-every", "960", "--schedule.checkpoint-every", "960", "--out", str(run)]) == 0
    ask = ["--guidance", "calibration", "--scenario", "aslant", "--labels", "30"]
    assert main(["adapt", str(run), *ask, "--base.seeds", "1", "0", "--out", str(out)]) == 0
    values = json.loads((out / "policy.json").read_text())
    assert (values["lanes"]["seeds"], values["lanes"]["base"], values["rows"]) == ([1, 0], [0, 1], 2)
    task = {"task": "own_askew:TASK"}
    for seed, found in zip((1, 0), values["calibration"], strict=True):
        better, base = (cl.load_policy(out, policy=name, seed=seed, **task)(SEEN) for name in ("adapted", "base"))
        np.testing.assert_array_equal(base, cl.load_policy(run, seed=seed, **task)(SEEN))
        turn = found["estimates"][0]["mean"] if found["changes"] else 0.0
        wanted = rotate(jnp.asarray(base), -jnp.deg2rad(turn))
        np.testing.assert_allclose(better, wanted, atol=1e-5)
    assert main(["adapt", str(out), *TASK, *ask, "--base.seeds", "0", "--out", str(again)]) == 0
    moved = cl.load_policy(again, policy="base", **task)(SEEN)
    np.testing.assert_allclose(moved, cl.load_policy(out, seed=0, **task)(SEEN), atol=1e-6)
    assert main(["evaluate", str(again), *TASK, "--compare", "base", "--steps", "400", "--envs", "20"]) == 0


def test_no_change_is_said_and_the_policy_stays(home):
    world = cl.make("own_askew:TASK")
    with pytest.warns(UserWarning, match="ask for no change. The policy stays as it was"):
        same = cl.adapt(own().straight, world, cl.teacher_of(world), labels=20, guidance="calibration")
    assert not same.used
    assert same.result is not None
    assert same.result.verdict == "nothing changed"
    np.testing.assert_allclose(same(SEEN), SEEN, atol=1e-6)


def test_changes_of_ones_own_are_code_that_is_named_again(home, tmp_path, capsys):
    out = tmp_path / "twisted"
    assert main([*ASK[:-1], "40", "--changes", "own_askew:changes", "--out", str(out)]) == 0
    named_again = next_command(capsys.readouterr().out)
    assert named_again[2:] == [
        *("--env", "own_askew:TASK", "--base", "own_askew:straight", "--changes", "own_askew:changes")
    ]
    layer = json.loads((out / "policy.json").read_text())["policy"]
    assert (layer["distortions"], layer["code"]) == (["twist"], "own_askew:changes")
    code = {"task": "own_askew:TASK", "base": own().straight}
    assert apart_deg(cl.load_policy(out, changes=own().TWIST, **code)(SEEN), TURNED) < 4
    with pytest.raises(cl.UserError, match="not loaded because a file names it: add --changes own_askew:changes"):
        cl.load_policy(out, **code)
    with pytest.raises(cl.UserError, match="corrects 'twist', which own_askew:changes lacks"):
        cl.load_policy(out, changes=own().TWIST._replace(name="bend"), **code)
    for measure in (named_again, [*named_again[:-1], "own_askew:TWIST"]):
        assert main([*measure, "--steps", "400", "--envs", "20"]) == 0


def test_what_calibration_cannot_use_is_refused(home, refused, tmp_path):
    ask = [*ASK, "--out", tmp_path / "new"]
    for option, value, told in (
        ("--bound-deg", "20", "no model and has no bound: leave bound_deg out"),
        ("--sizes.fit-steps", "20", "sizes.fit_steps is 20, but calibration fits no model"),
        ("--scalars.k-max", "3", "leave scalars.k_max out"),
        ("--judge-bounds", "0.5", "leave judge_bounds out"),
        ("--scalars.answer", "shuffled", "a control of feedback models"),
        ("--changes", "own_askew:WRONG", "'twist': sees changes rows although all of its unknowns are zero"),
        ("--changes", "own_askew:SEEN", "has no 'SEEN'"),
        ("--changes", "own_askew:OWN", "has no 'OWN'"),
    ):
        refused([*ask, option, value], told, tmp_path)
    refused([*ask[:-4], "--labels", "4", *ask[-2:]], "labels is 4: give at least 5", tmp_path)
    relative = [*ask, "--guidance", "relative", "--changes", "own_askew:TWIST"]
    relative = [word for word in relative if word != "calibration"]
    relative.remove("--guidance")
    refused(relative, "give guidance calibration", tmp_path)
    refused(
        ["train", "own_askew:TASK", "--guidance", "calibration", *ask[-2:]],
        "use it with `cuelearner adapt` only",
        tmp_path,
    )
