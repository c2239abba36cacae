"""Policy folders of the bandit, as `adapt` writes them, of an agent and a guide, or changes, that learned nothing."""

import dataclasses

import jax
import numpy as np
import probes

from cuelearner_jax.adaptation.by_model import AdaptationResult
from cuelearner_jax.adaptation.by_reading import ReadingAdaptation, ReadingLanes
from cuelearner_jax.adaptation.judging import Judgement
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes, begin
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Agent, Common
from cuelearner_jax.reading import declared_distortions
from cuelearner_jax.reading.policy import unread
from cuelearner_jax.runs import adapted
from cuelearner_jax.storage import policy_folders

TASK = probes.make_task()
ENV = TASK.environment(probes.CONFIG.task)
SIZES = GuideSizes(**{field.name: getattr(probes.SIZES, field.name) for field in dataclasses.fields(GuideSizes)})
LANES = Lanes(*(np.array(column) for column in ([0, 0], [0, 1], [10, 10], [45.0, 45.0])))


def find(name):
    """The one task that is known here."""
    if name != TASK.name:
        raise UserError(f"unknown task {name!r}")
    return TASK


def agent():
    """An untrained agent."""
    functions = probes.CONFIG.agent_in(ENV)
    return Agent(functions.init(jax.random.key(4))[0], functions, ENV)


def write(folder, overwrite=False, origin="run", read=False):
    """Write the folder; `origin`: what policy.json says was adapted."""
    kind, family = ("reading", (declared_distortions(ENV),)) if read else ("relative", ())
    guidance = guidances.make(kind, SIZES, ENV)
    of = (ReadingAdaptation if read else Adaptation)(guidance, SIZES, probes.SCALARS, ENV, Common(agent()), *family)
    worth = np.zeros(2), np.ones(2), np.ones(2, bool), np.full(2, 45.0)
    judged = Judgement("reward", *worth, difference=np.ones((2, 3)), rewarded_steps=np.zeros(2, int))
    block = begin(of, LANES)
    if read:
        nothing = unread(None, actions_of(ENV), of.family, ENV.obs_size).correction
        both = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), nothing)
        yes = np.ones(2, bool)
        block = ReadingLanes(LANES.base, both, block.labels, block.bound, yes, np.zeros(2), yes, ~yes)
    found = AdaptationResult(of, LANES, block, judged)
    with policy_folders.place_of(folder, overwrite) as place:
        adapted.write(place, found, TASK, probes.CONFIG.task, {"folder": origin}, {})
