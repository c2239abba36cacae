"""A correction of proposed actions in a copy of a LeRobot checkpoint: its files, its golden cases, what is refused."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded_situations import plugin_module

from cuelearner_jax.adaptation.judging import PairedTest
from cuelearner_jax.environment import BASE, EFFECT
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import lerobot
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.reading import ReadingPolicy
from cuelearner_jax.reading.families import ACTIONS_ALONE, declared_distortions
from cuelearner_jax.reading.policy import unread
from cuelearner_jax.tasks import logs

CONFIG = logs.LogsConfig(
    names=("x", "y", "phase", BASE), entries=(1, 1, 1, 2), low=(-1.0, 0.0), high=(1.0, 4.0), rows=20
)
ROBOT = {
    "input_features": {"observation.state": {"type": "STATE", "shape": [2]}},
    "output_features": {"action": {"type": "ACTION", "shape": [2]}},
    "n_action_steps": 5,
}


def step(name, **config):
    return {"registry_name": name, "config": config}


def checkpoint(folder, robot=ROBOT, more=()):
    """Write the parts of a checkpoint that matter here."""
    folder.mkdir()
    pre = [step("to_batch_processor"), *more, step("normalizer_processor")]
    post = [step("unnormalizer_processor"), step("device_processor")]
    for name, contents in (
        ("config", robot),
        ("policy_preprocessor", {"steps": pre}),
        ("policy_postprocessor", {"steps": post}),
    ):
        (folder / f"{name}.json").write_text(json.dumps(contents))
    return folder


@pytest.fixture(scope="module")
def env():
    random = np.random.default_rng(0)
    actions = random.uniform(CONFIG.low, CONFIG.high, (20, 2))
    rows = np.concatenate([random.uniform(0, 9, (20, 2)), random.uniform(0, 1, (20, 1)), actions], 1)
    return logs.filled(CONFIG, rows.astype(np.float32), actions.astype(np.float32))


@pytest.fixture(scope="module")
def policy(env) -> ReadingPolicy:
    """A correction with a shift, gains and a process of the state and the phase; one entry never changed."""
    read = unread(Heuristic(env.view()), env.actions, ACTIONS_ALONE, env.obs_size, labels=6)
    random = lambda number, *shape: jax.random.normal(jax.random.key(number), shape)  # noqa: E731
    change = read.correction.change.replace(action=0.3 * random(0, 2, 3))
    frame = read.correction.frame.replace(
        mean=jnp.full(5, 2.0), deviation=jnp.full(5, 3.0), varies=jnp.ones(5).at[1].set(0.0)
    )
    own = {"known": random(1, 6, 7), "alpha": random(2, 6, 2), "length": jnp.full(7, 1.5), "scale": jnp.float32(0.1)}
    return read.replace(correction=read.correction.replace(change=change, frame=frame, **own), bound=jnp.float32(0.2))


def test_a_checkpoint_gets_the_steps_the_arrays_and_the_golden_cases(env, policy, tmp_path):
    lerobot.write(policy, env, (), checkpoint(tmp_path / "before"), tmp_path / "after", {})
    pre, post = (json.loads((tmp_path / "after" / name).read_text())["steps"] for name in (lerobot.PRE, lerobot.POST))
    named = lambda steps: [one.get("registry_name") or one["class"].rpartition(".")[2] for one in steps]  # noqa: E731
    assert named(pre) == ["to_batch_processor", "StateStep", "normalizer_processor"]
    assert named(post) == ["PlaceStep", "unnormalizer_processor", "CorrectStep", "device_processor"]
    assert post[2]["config"] == {"pair": pre[1]["config"]["pair"], "chunk": 5, "version": lerobot.VERSION}


def test_a_shift_of_the_state_goes_to_the_policy_and_effects_do_not_go_along(env, tmp_path):
    config = dataclasses.replace(CONFIG, names=(*CONFIG.names[:3], EFFECT, BASE), entries=(1, 1, 1, 4, 2))
    wide = logs.filled(config, np.insert(np.asarray(env.rows), [3] * 4, 1.0, 1), np.asarray(env.recorded))
    read = unread(Heuristic(wide.view()), wide.actions, declared_distortions(wide), wide.obs_size)
    change = read.correction.change.replace(theta=jnp.array([0.5, -1.0]))
    read = read.replace(correction=read.correction.replace(change=change))
    arrays = lerobot.arrays_of(read, wide)
    np.testing.assert_allclose(arrays["golden_action"], arrays["golden_obs"][:, 3:], atol=1e-6)  # of the shifted state
    lerobot.write(read, wide, (), checkpoint(tmp_path / "before"), tmp_path / "after", {})
    assert json.loads((tmp_path / "after" / lerobot.PRE).read_text())["steps"][1]["config"]["state_shift"] == [-0.5, 1]


def test_a_correction_of_a_hand_brings_its_kinematics_to_the_checkpoint_of_the_joints(env, policy, tmp_path):
    joints = {"entries": ["pan", "lift", "jaw"], "joints": [[1, 0], [0, 1], [0, 0]], "high": [float("inf"), 2.0]}
    arm = {"output_features": {"action": {"shape": [3]}}, "action_feature_names": ["pan", "lift", "jaw"]}
    before = checkpoint(tmp_path / "before", ROBOT | arm)
    lerobot.write(policy, env, ("x", "y"), before, tmp_path / "after", joints)
    stored = (tmp_path / "after" / lerobot.STATE_FILE).read_bytes()
    described = json.loads(stored[8 : 8 + int.from_bytes(stored[:8], "little")])
    assert (described["hand_joints"]["shape"], described["hand_high"]["shape"]) == ([3, 2], [2])
    with pytest.raises(UserError, match="moves pan, lift, jaw, the correction lift, pan, jaw"):
        lerobot.write(policy, env, (), before, tmp_path / "no", joints | {"entries": ["lift", "pan", "jaw"]})


def test_the_steps_decide_as_jax_does(env, policy, tmp_path):
    torch = pytest.importorskip("torch")
    arrays = {name: torch.tensor(array) for name, array in lerobot.arrays_of(policy, env).items()}
    decide = plugin_module("correction").Correction(arrays)  # replays the golden cases
    beyond = torch.tensor([[-3.0, -2.0], [-3.0, -2.0], [0.5, 2.0]])
    moved = decide(torch.zeros(3, 2), torch.tensor([0.0, 1.0, 1.0]), beyond) - beyond
    at_bound = decide(torch.zeros(1, 2), torch.tensor([1.0]), torch.tensor([[-1.0, 0.0]])) - torch.tensor([[-1.0, 0.0]])
    assert torch.allclose(moved[1], at_bound[0], atol=1e-6)  # as far as the action at the bounds
    assert not torch.allclose(moved[0], moved[1], atol=1e-3)  # the phase matters
    with pytest.raises(ValueError, match="decides golden cases otherwise"):
        type(decide)(arrays | {"beta": arrays["beta"] + 0.1})
    with pytest.raises(ValueError, match="state and action have 3 and 2 entries"):
        decide(torch.zeros(1, 3), torch.zeros(1), beyond[:1])


@pytest.mark.parametrize(
    ("robot", "more", "told"),
    [
        ({"input_features": {"observation.state": {"shape": [6]}}}, (), "observation.state has 6 entries"),
        ({"output_features": {"action": {"shape": [7]}}}, (), "action has 7 entries"),
        ({"input_features": {}}, (), "observation.state is missing"),
        ({"action_feature_names": ["pan", "lift"]}, (), "moves pan, lift, the correction x, y"),
        ({}, (step("relative_actions_processor", enabled=True),), "has relative actions"),
        ({}, ({"class": f"{lerobot.STEPS}.StateStep", "config": {}},), "holds a correction already"),
    ],
)
def test_a_checkpoint_of_another_robot_is_refused(robot, more, told, env, policy, tmp_path):
    before = checkpoint(tmp_path / "before", ROBOT | robot, more)
    with pytest.raises(UserError, match=told):
        lerobot.write(policy, env, ("x", "y"), before, tmp_path / "after", {})
    assert not (tmp_path / "after").exists()


def evaluation(folder, *each):
    """Write what `lerobot-eval` writes of tasks with these successes."""
    folder.mkdir()
    tasks = [{"task_group": "pusht", "task_id": n, "metrics": {"successes": own}} for n, own in enumerate(each)]
    (folder / "eval_info.json").write_text(json.dumps({"per_task": tasks}))
    return folder


def test_paired_episodes_tell_which_checkpoint_is_better(tmp_path):
    judging = plugin_module("judging")
    # seven wins: the mean of (1 + stake)^7 is 26.9, of six 15.6; a tie tells nothing
    before = evaluation(tmp_path / "before", [False] * 6 + [True] + [False] * 3)
    after = evaluation(tmp_path / "after", [True] * 10)
    assert judging.judge(before, after) == "better after 8 of 10 pairs of episodes: success 0.10 -> 1.00"
    assert judging.judge(after, before).startswith("worse after 8 of 10")
    lost, won = [[False] * 10], [[True] * 10]  # the first of ten tasks is won, the others are lost
    pair = evaluation(tmp_path / "one", *lost, *9 * won), evaluation(tmp_path / "other", *won, *9 * lost)
    line = judging.judge(*pair)
    assert line.startswith("worse")
    assert line.endswith("of 10 pairs of episodes of each task: success 0.90 -> 0.10")
    with pytest.raises(SystemExit, match="evaluate both alike"):
        judging.judge(before, evaluation(tmp_path / "short", [True] * 3))
    with pytest.raises(SystemExit, match="holds no results"):
        judging.judge(before, tmp_path)
    for wins in np.random.default_rng(0).choice([-1, 0, 1], (40, 60), p=(0.1, 0.5, 0.4)):
        test = PairedTest(1)
        test.add(wins[None])
        verdict = "better" if test.better[0] else "worse" if test.worse[0] else "not told apart"
        assert judging.decide(wins)[0] == verdict
