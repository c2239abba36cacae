"""The examples: what their docstrings tell to type, at a tiny scale, and what is refused of them."""

import contextlib
import dataclasses
import importlib
import json
import re
import shlex
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import numpy as np
import probes
import pytest
from PIL import Image

from cuelearner_jax import loop
from cuelearner_jax.agents.protocol import AGENTS, AgentFunctions
from cuelearner_jax.arbiters import ARBITERS
from cuelearner_jax.cli import main
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.storage import results
from cuelearner_jax.tasks import registry as tasks
from cuelearner_jax.testing import check_environment, check_guidance, check_policy, check_task

ROOT = Path(__file__).resolve().parents[2]
TINY = shlex.split("""
    --agent.q-layers 8 --sizes.feedback-layers 8 --agent.directions 6 --agent.target-directions 6 --sizes.fit-steps 20
    --sizes.labels-per-round 5 --schedule.total-steps 40 --schedule.random-steps 10 --schedule.learn-after 10
    --schedule.guidance-until 20 --schedule.eval-every 20 --schedule.eval-steps 800 --schedule.eval-envs 4
    --schedule.checkpoint-every 40
""")
SMALL = {
    "train": [*TINY, "--labels", "5"],
    "sweep": [*TINY, "--labels", "5", "--seeds", "2"],
    "evaluate": ["--episodes", "4"],
    "render": ["--steps", "2"],
    "report": [],
}


@contextlib.contextmanager
def stranger():
    """A process that knows no task, part or kind of the examples, and forgets them again."""
    with contextlib.ExitStack() as stack:
        for table in (guidances.guides(), tasks._registered, AGENTS, ARBITERS):
            stack.enter_context(mock.patch.dict(table))
            for name in {*table} & {"clone", "soft", "late"}:
                del table[name]
        tasks._registered.clear()
        yield


@pytest.fixture(autouse=True)
def there(monkeypatch):
    """In the folder above the examples."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with stranger():
        yield


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("examples")


def documented(name):
    """The commands of an example's docstring."""
    text = (ROOT / "examples" / f"{name}.py").read_text().split('"""')[1]
    return [shlex.split(line)[1:] for line in re.findall(r"^    (cuelearner .*)$", text, re.MULTILINE)]


def at_home(command, home):
    """A documented command with its folders at `home`, at a tiny scale (options typed later win)."""
    moved = [re.sub(r"^(runs|pictures)\b", lambda found: str(home / found[0]), part) for part in command]
    given = set(re.findall(r"--\S+", " ".join(moved)))
    options = SMALL[command[0]]
    pairs = [[option, value] for option, value in zip(options[::2], options[1::2], strict=True)]
    return moved + [part for pair in pairs if pair[0] not in given for part in pair]


@pytest.fixture(scope="module")
def runs(home):
    """The folders that the documented commands leave, each run as a process of its own would."""
    with contextlib.chdir(ROOT):
        for command in (command for name in ("reach", "clone", "brax_task") for command in documented(name)):
            with stranger():
                assert main(at_home(command, home)) == 0, command
    return home / "runs"


@pytest.mark.long
def test_the_documented_commands_run(runs, home):
    assert [len(documented(name)) for name in ("reach", "clone", "brax_task", "policy")] == [5, 3, 2, 0]
    assert {row["guidance"] for row in results.read(runs / "reach").to_pylist()} == {"none", "relative"}
    assert {row["guidance"] for row in results.read(runs / "clone").to_pylist()} == {"none", "clone"}
    assert {row["task"] for row in results.read(runs / "pendulum").to_pylist()} == {"pendulum"}
    assert (runs / "reach" / "report").is_dir()
    for name, size in (("reach-agent.png", (480, 480)), ("reach-agent-question.png", (480, 480))):
        picture = np.asarray(Image.open(home / "pictures" / name).convert("RGB"))
        assert picture.shape[:2] == size
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    with Image.open(home / "pictures" / "reach-agent.gif") as film:
        assert film.n_frames >= 2


def refused(capsys, command, says):
    capsys.readouterr()
    with stranger():
        assert main([str(part) for part in command]) == 2
    assert says in capsys.readouterr().err.splitlines()[-1]  # earlier lines say which lane is looked at


@pytest.mark.long
def test_a_kind_from_outside_must_be_named_again(runs, capsys):
    command = ["evaluate", runs / "clone", "--task", "examples.reach:TASK"]
    refused(capsys, command, "--guidance package.module:NAME")
    refused(capsys, [*command, "--guidance", "clone"], "--guidance package.module:NAME")
    refused(capsys, ["render", *command[1:], "--out", runs / "new"], "--guidance package.module:NAME")
    assert not (runs / "new").exists()
    with stranger():
        assert main([*map(str, command), "--guidance", "none", *SMALL["evaluate"]]) == 0  # the other lanes need no code


BANDIT = """
from dataclasses import replace
from probes import CONFIG, make_task
from cuelearner_jax.task import Preset
TASK = replace(make_task("own_parts"), presets={"quickstart": Preset("tiny", CONFIG)})
"""
PARTS = ["--agent", "examples.soft_agent:Config", "--arbiter", "examples.late_arbiter:Config"]
OPTIONS = shlex.split("""
    --agent.layers 8 --agent.actions 6 --agent.temperature 0.2 --agent.batch-size 8 --agent.replay-capacity 80
    --agent.learning-rate 0.02 --arbiter.after 0 --arbiter.probability 0.25
    --schedule.total-steps 80 --schedule.guidance-until 60 --schedule.eval-every 40 --schedule.checkpoint-every 40
""")


def test_an_agent_and_an_arbiter_of_ones_own_train_and_are_evaluated(tmp_path, monkeypatch, capsys):
    (tmp_path / "own_parts.py").write_text(BANDIT)
    monkeypatch.syspath_prepend(tmp_path)
    run = str(tmp_path / "run")
    command = ["sweep", "own_parts:TASK", "--preset", "quickstart", *PARTS, *OPTIONS]
    command += ["--guidance", "heuristic", "--seeds", "1", "--out", run]
    with stranger():
        assert main(command) == 0
    described = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (described["agent"]["name"], described["agent"]["temperature"]) == ("soft", 0.2)
    assert described["arbiter"] == {"name": "late", "after": 0, "probability": 0.25}
    losses = [row["train_loss"] for row in results.read(tmp_path / "run").to_pylist() if row["step"]]
    assert 0 < min(losses) < max(losses) < 1
    evaluated = ["evaluate", run, "--task", "own_parts:TASK", "--steps", "40", "--envs", "4"]
    refused(capsys, evaluated, "package.module:NAME")  # no code is loaded that a file names
    with stranger():
        assert main([*evaluated, *PARTS]) == 0
    assert "hit" in capsys.readouterr().out


def test_the_soft_agent_learns_the_soft_values_of_a_chain():
    """Q(1, a) = a_x, and Q(0, a) = a_y / 2 + discount * temperature * log mean exp(Q(1, .) / temperature)."""
    soft = importlib.import_module("examples.soft_agent")
    heat, discount = 0.5, 0.5
    options = soft.Config((8,), actions=4, temperature=heat, batch_size=16, replay_capacity=1200, learning_rate=0.02)
    config = dataclasses.replace(
        probes.config(sizes={"num_envs": 2}, scalars={"discount": discount}, schedule={"random_steps": 100}),
        agent=options,
    )
    env = probes.Chain(False)
    program = probes.chain_program(config, "none")
    _, state, _ = program.train(env, config.settings, loop.start_clock(), probes.start(program, [0], [0], env), 600)
    agent, params = options.make("raw", spaces_of(env), True), probes.lane(state.agent.params, 0)
    assert isinstance(agent, AgentFunctions)
    start, end = (np.asarray(agent.value(env, params, env.observe(place), agent.choices)) for place in (0, 1))
    east = np.array([1.0, 0.0, -1.0, 0.0])  # x of the four actions
    following = discount * heat * np.log(np.mean(np.exp(east / heat)))
    np.testing.assert_allclose(end, east, atol=0.1)
    np.testing.assert_allclose(start, np.roll(east, 1) / 2 + following, atol=0.1)
    assert following == pytest.approx(0.2, abs=0.05)  # a greedy target would have 0.5


@pytest.mark.long
def test_the_parts_keep_the_laws(tmp_path):
    names = ("reach", "clone", "brax_task", "policy")
    reach, clone, brax, policy = (importlib.import_module(f"examples.{name}") for name in names)
    config = reach.ReachConfig(max_steps=8, mirrors=True)
    check_task(reach.TASK, config, pictures=tmp_path)
    env = reach.make_environment(config)
    check_guidance(clone.Clone, env)
    for one in policy.policies(env).values():
        check_policy(one, env)
    check_task(brax.TASK)
    check_environment(brax.make_environment(brax.PendulumConfig(max_steps=4)), steps=12, tolerance=1e-4)
    with pytest.raises(UserError, match=r"task\.wind is -1"):
        reach.make_environment(dataclasses.replace(config, wind=-1))


@pytest.mark.long
def test_any_function_is_corrected(capsys):
    from examples.correct_a_policy import main as correct

    rates = correct(worlds=4, labels=20, episodes_judged=4, episodes_measured=4)
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == ["compass", "refined"]
    assert all(rate in (0.0, 0.25, 0.5, 0.75, 1.0) for rate in rates)


@pytest.mark.long
def test_a_constant_error_in_a_gymnasium_class_of_ones_own_falls_to_a_fifth():
    pytest.importorskip("gymnasium")
    from examples.correct_in_gymnasium import main as correct

    found = correct()
    assert found["corrected"] < 0.2 * found["as it was"]
    assert found["answers by chance"] > 0.5 * found["as it was"]


def test_the_shots_that_the_page_on_billiards_shows_are_won(capsys):
    page = (ROOT / "docs" / "billiards.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    told: dict = {}
    exec(shown, told)
    printed = capsys.readouterr().out
    # The numbers of the page's comments, but for directions on the edge of a window in another build's rounding.
    assert abs(int(told["won"].sum()) - 51) <= 3
    assert re.search(r"(\d+) of 3600 directions win", printed)
    assert told["shot"].pocketed.tolist() == [False, False, False, True]
    assert float(told["shot"].duration) == pytest.approx(3.1, abs=0.05)


def test_slurm_gets_one_command_a_piece_which_saves_when_its_job_ends(tmp_path):
    pytest.importorskip("submitit")
    piece = importlib.import_module("examples.slurm_sweep").Piece(["billiards", "--out", "runs/a"], 2, 16)
    assert piece.command[-6:] == ["sweep", "billiards", "--out", "runs/a", "--shard", "2/16"]
    saves = f"trap 'touch {tmp_path}/saved; exit 143' TERM; touch {tmp_path}/up; while :; do sleep 0.05; done"
    piece.command = ["sh", "-c", saves]
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(piece)
        while not (tmp_path / "up").exists():
            time.sleep(0.05)
        assert piece.checkpoint().function is piece
        assert (tmp_path / "saved").exists()
        with pytest.raises(subprocess.CalledProcessError):
            done.result()
