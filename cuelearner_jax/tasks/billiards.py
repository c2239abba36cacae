"""Define the billiards task: its teachers, presets, changed worlds and pictures."""

from __future__ import annotations

import dataclasses
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from cuelearner_envs import billiards
from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.teacher import LocalSearchTeacher, NearbyTeacher, SearchTeacher, Transferred
from cuelearner_jax import teachers
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import Body, Pictures, Preset, Scenario, Task
from cuelearner_jax.types import Teacher

SHIPPED_TEACHERS = Path(billiards.__file__).parent / "teachers"


# Fields in which a learned teacher's world may differ from its own: the teacher and its search, data augmentation, and
# changes that `Transferred` accounts for.
TEACHERS = ("teacher", "aim_error_deg", "habit", "search_directions")
TRANSFERRED = (*TEACHERS, "mirrors", "action_turn_deg", "observation_bias")
# largest tilt at which a learned teacher still proposes nearly good shots [m/s^2], see docs/billiards.md
SLIGHT_TILT = 0.02
LOCAL_SEARCH = "local_search"


# The paper's networks, with the fastest search.
AGENT = ddqn.Config(coarse_directions=720, coarse_dtype="bfloat16", peaks=8)
# The action frame and pacing learn fastest here, see docs/results.
SEEN_FROM_THE_STRIKE = Sizes(frame="action", num_envs=100)
PACED = Paced(lead=0.5)  # a guide gets its whole share if it earns half a shot more than the agent, less below


def teacher_folder(config: BilliardsConfig) -> Path | None:
    """Return the folder of a configuration's teacher; None for one that was not trained."""
    if config.teacher == "search":
        return None
    return SHIPPED_TEACHERS / config.table if config.teacher in ("learned", LOCAL_SEARCH) else Path(config.teacher)


def make_teacher(config: BilliardsConfig, env: Any) -> Teacher:
    """Return the teacher of a configuration.

    Raises UserError if there is none, or if it cannot account for a change in this world.
    """
    aim_error = jnp.deg2rad(jnp.array(config.aim_error_deg, jnp.float32))
    habit = jnp.array(config.habit, jnp.float32)
    folder = teacher_folder(config)
    if folder is None:
        return SearchTeacher(env, aim_error, habit, config.search_directions)
    told = _learned_in(folder, config)
    own = make_environment(told)
    network = teachers.load(folder, own, aim_error, habit)
    if type(env) is not Billiards:  # for other physics, the network only proposes where to try
        return NearbyTeacher(Transferred(network, own, env), env, aim_error)
    if config.teacher == LOCAL_SEARCH or told.acceleration != config.acceleration:
        return LocalSearchTeacher(network, own, env, aim_error, habit)
    return Transferred(network, own, env)


def _learned_in(folder: Path, config: BilliardsConfig) -> BilliardsConfig:
    """Return the training world of a teacher used in another world. Raises UserError for a change it cannot handle.

    On a slightly tilted table its proposals are still near good shots; simulated shots then decide among them.
    """
    try:
        return teachers.world_of(folder, "billiards", config, TRANSFERRED)
    except UserError as refusal:
        with suppress(UserError):
            told = teachers.world_of(folder, "billiards", config, (*TRANSFERRED, "acceleration"))
            if math.dist(told.acceleration, config.acceleration) <= SLIGHT_TILT:
                return told
        raise refusal


def _files(config: BilliardsConfig) -> dict[str, str]:
    """Return the digest of the user's own teacher, if there is one."""
    folder = teacher_folder(config)
    own = folder and config.teacher not in ("learned", LOCAL_SEARCH)
    return {"teacher": teachers.digest(folder)} if folder and own else {}


def _pictures() -> Pictures:
    from cuelearner_envs.billiards import drawing  # takes seconds to load
    from cuelearner_envs.billiards.recording import record
    from cuelearner_envs.billiards.sketch import reel, sketch, trails

    return Pictures(
        record=record,
        still=lambda env, paths, file: drawing.still(env.table, paths[0], file),
        animate=lambda env, paths, file: drawing.animate(env.table, paths, file),
        question=lambda env, state, obs, action, file: drawing.question(
            env.table, state.positions, state.pocketed, action, file
        ),
        sketch=sketch,
        reel=reel,
        trails=trails,
        legend="Thin lines: the paths of the white ball (solid) and of the ball that it hits (dashed), within three "
        "seconds. A disc: a ball is pocketed. A cross: the white ball is pocketed, a foul.",
    )


PLAYER = Body(
    name="player",
    about="strikes the cue ball with a fixed speed",
    # splits differ only in the racks, which the key determines
    environment=lambda config, split: make_environment(config),
    pictures=_pictures,
)


def _foreign(config: BilliardsConfig, split: str) -> Environment:
    from cuelearner_envs.pooltool.environment import make_environment

    return make_environment(config)


POOLTOOL = Body(
    name="pooltool",
    about="strikes on a table with cloth, spin and cushions, simulated by pooltool in processes of their own",
    environment=_foreign,
)

# Settings of the adapted agents in docs/results/adaptation.md. The teacher tries shots in the changed world and prefers
# the good shot nearest to the agent's, and the guide sees how far a shot has been turned.
NEAREST: dict[str, Any] = {"answer": "nearest", "nearest_aim_deg": 0.1, "feedback_learning_rate": 3e-4}
RECIPE: dict[str, Any] = {"eps_deg": 0.1, "guidance": "reading"}

# The worlds of the paper's section on adaptation after training.
SCENARIOS = {
    "turned_strike": Scenario(
        "every strike is turned by 0.8 degrees",
        {"action_turn_deg": 0.8, "teacher": LOCAL_SEARCH},
        bound_deg=1.0,
        scalars={**NEAREST, "nearest_share": 0.9},
        **RECIPE,
    ),
    "shifted_balls": Scenario(
        "balls are seen 7.1 mm to the right of and above their places",
        {"observation_bias": (0.0071, 0.0071), "teacher": LOCAL_SEARCH},
        bound_deg=0.3,
        scalars={**NEAREST, "nearest_share": 0.9},
        **RECIPE,
    ),
    "tilted_table": Scenario(
        "the table is tilted: balls are drawn along y",
        {"acceleration": (0.0, 0.005), "teacher": LOCAL_SEARCH},
        bound_deg=0.3,
        scalars={**NEAREST, "nearest_share": 0.6},
        **RECIPE,
    ),
}

BILLIARDS = Task(
    name="billiards",
    about="pocket the target balls with one shot a step",
    wants=lambda config: (
        "The white ball is struck along the arrow. A coloured ball should be pocketed, the white ball never."
    ),
    near_aims=True,
    config=BilliardsConfig,
    bodies=(PLAYER, POOLTOOL),
    teacher=make_teacher,
    files=_files,
    scenarios=SCENARIOS,
    labels_hold=("mirrors", *TEACHERS),
    presets={
        "paper": Preset(
            "the paper's figure: regulation table, its networks, 10 million steps a seed",
            RunConfig(
                BilliardsConfig("regulation", teacher="learned", aim_error_deg=0.25),
                # The reference alternates 1,000 steps with 1,000 gradient steps; this alternates 100 with 100.
                Sizes(num_envs=100),
                schedule=Schedule(guide_eval_every=50),
                agent=AGENT,
            ),
            guidance=("none", "relative", "heuristic"),
            labels=(500, 1000),
            takes="one seed: 25 minutes on one H200; more than a day on 2 cores; both by arithmetic",
        ),
        "regulation": Preset(
            "the paper's table seen from the strike: its reward after 10 million steps within 2 million",
            RunConfig(
                BilliardsConfig("regulation", teacher="learned", aim_error_deg=0.25),
                SEEN_FROM_THE_STRIKE,
                schedule=Schedule(
                    total_steps=2_000_000,
                    guidance_until=500_000,  # until this step guidance was measured to help
                    eval_every=50_000,
                    checkpoint_every=250_000,
                    guide_eval_every=50,
                ),
                agent=dataclasses.replace(AGENT, replay_capacity=2_000_000),
                arbiter=PACED,
            ),
            guidance=("none", "intent", "relative"),
            labels=(100, 500),
            takes="16 seeds under one guidance: 15 minutes on one H200; one: hours on 2 cores; both by arithmetic",
        ),
        "easy": Preset(
            "larger balls and pockets, seen from the strike, the paper's networks, 1 million steps a seed",
            RunConfig(
                BilliardsConfig("easy", teacher="learned"),
                SEEN_FROM_THE_STRIKE,
                schedule=Schedule(
                    total_steps=1_000_000, guidance_until=500_000, checkpoint_every=100_000, guide_eval_every=50
                ),
                agent=dataclasses.replace(AGENT, replay_capacity=1_000_000),
                arbiter=PACED,
            ),
            guidance=("none", "intent", "relative", "heuristic"),
            labels=(100, 500),
            takes="16 seeds under one guidance: 10 minutes on one H200; one: hours on 2 cores; both by arithmetic",
        ),
        "quickstart": Preset(
            "one ball, small networks, 3,000 steps a seed",
            RunConfig(
                BilliardsConfig("one_ball"),
                Sizes(feedback_layers=(128, 128), num_envs=10, fit_steps=400, fit_batch_size=64),
                Scalars(eps_deg=2.0, k_max=100),
                Schedule(
                    total_steps=3_000,
                    random_steps=200,
                    learn_after=200,
                    guidance_until=1_500,
                    eval_every=100,
                    eval_steps=100,
                    eval_envs=50,
                    checkpoint_every=500,
                ),
                ddqn.Config(q_layers=(128, 128), directions=360, replay_capacity=20_000, learning_rate=0.01),
                Paced(lead=0.25),
            ),
            guidance=("none", "relative"),
            labels=(100,),
            seeds=24,
            first_seed=2000,  # the settings were chosen on seeds below 2000
            takes="24 seeds under two kinds of guidance: two minutes on 2 cores",
        ),
    },
)
