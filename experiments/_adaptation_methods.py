"""Methods of the studies of adaptation: each returns a piece's rows, for all base agents and budgets.

A row is a dictionary of columns, each a number for all lanes or an array (lanes,). `_adaptation.Bench` says where a
piece is run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import _coach as coach
import _residual as residual
import _trajectories as trajectories
import jax.numpy as jnp
import numpy as np
from _finetuning import FineTuning, every

from cuelearner_jax.adaptation import by_model, by_reading
from cuelearner_jax.adaptation.by_model import AdaptationResult
from cuelearner_jax.adaptation.judging import LABELS, Judging, judged_by_labels
from cuelearner_jax.adaptation.lanes import Adaptation, product
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import actions_of, spaces_of
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Corrected
from cuelearner_jax.reading import declared_distortions
from cuelearner_jax.types import Label

if TYPE_CHECKING:
    from _adaptation import Bench

SHUFFLED = "shuffled"  # a variant of reading
UNREWARDED = "unrewarded_"  # columns of the same models where held-out answers judge, in place of episodes
JUDGED = 500  # environments at most in which it is decided whether a model is used
Row = dict[str, Any]


def measured_as_they_are(bench: Bench) -> Iterator[Row]:
    """The base agents themselves."""
    agents = bench.agents.replace(view=bench.env(bench.piece.split))
    yield {"base": bench.seeds, "labels": 0, "steps": 0, **bench.measured(agents)}


def corrected(bench: Bench) -> Iterator[Row]:
    """Correct by the teacher's own answers, refined as by a model of them, within the same bound."""
    env = bench.env(bench.piece.split)
    scalars = dataclasses.replace(bench.scalars(), tau_max_deg=bench.piece.bound_deg)
    teacher = bench.task.make_teacher(bench.world, env)
    policy = Corrected(bench.agents.replace(view=env), teacher, scalars, actions_of(env))
    yield {"base": bench.seeds, "labels": 0, "steps": 0, **bench.measured(policy)}


def by_labels(kind: Any, bench: Bench) -> Iterator[Row]:
    """Adapt by labels of a kind of guidance, with every budget as a lane."""
    piece, env = bench.piece, bench.env("training")
    sizes = bench.set("sizes.", GuideSizes(frame=bench.config.sizes.frame))
    scalars = bench.scalars()
    options = bench.set(f"{kind.name}.", kind.config()) if kind.config else None
    guidance = kind.make(sizes, spaces_of(env), options)
    lanes = product(len(bench.seeds), range(piece.seeds), piece.labels, (piece.bound_deg,))
    envs = min(bench.envs, JUDGED)
    judge = Judging(bench.env("tuning"), envs, envs * bench.steps, piece.judge_by, bounds=piece.judge_bounds)
    of = Adaptation(guidance, sizes, scalars, env, bench.agents)
    found = by_model.adapt(of, lanes, judge, bench.task.make_teacher(bench.world, env))
    told = {"used": found.judged.used.astype(float), "failed": np.asarray(found.block.failed).astype(float)}
    told |= {
        "within_deg": found.judged.within_deg,
        "judged_before": found.judged.before,
        "judged_after": found.judged.after,
        "rewarded_steps": found.judged.rewarded_steps.astype(float),
        "eps_deg": scalars.eps_deg,
    }
    shown = bench.env(piece.split)
    metrics = bench.measured(found.policy(shown))
    if guidance.form is not None and guidance.form.by_eps:
        told |= {f"{UNREWARDED}{name}": values for name, values in unrewarded(bench, found).items()}
    if piece.ways:
        last = len(bench.seeds) * piece.seeds * (len(piece.labels) - 1)  # the first base with the largest budget
        policies = {"before": bench.agents.lane(0), "after": found.policy(shown).lane(last)}
        trajectories.write(bench.folder, shown, policies, piece.split, bench.steps)
    which = {"base": bench.seeds[lanes.base], "label_seed": lanes.seed, "labels": lanes.budget}
    yield {**which, "steps": 0, **told, **metrics}


def unrewarded(bench: Bench, found: AdaptationResult) -> Row:
    """Whether models are used where their held-out answers judge, and metrics (lanes,) of these policies."""
    judged = judged_by_labels(found.of, found.block)
    model = found.block.guide.model
    guide = found.block.guide.replace(model=model.replace(fitted=jnp.asarray(judged.used)))
    bound = actions_of(found.of.env).from_unit(jnp.asarray(found.lanes.bound_deg))  # episodes may have narrowed it
    block = found.block.replace(guide=guide, bound=bound)
    policy = found.of.policy(block, bench.env(bench.piece.split))
    return {"used": judged.used.astype(float), **bench.measured(policy)}


def by_residuals(bench: Bench) -> Iterator[Row]:
    """The correction itself, learned from optimal actions, in units of the bound."""
    settings = {"scalars.eps_deg": bench.piece.bound_deg, "scalars.tau_max_deg": bench.piece.bound_deg}
    settings |= {"scalars.k_max": 3, **bench.piece.settings}
    kind = residual.KIND
    yield from by_labels(kind, bench._replace(piece=bench.piece._replace(settings=settings)))


def fine_tuned(bench: Bench) -> Iterator[Row]:
    """Agents that go on learning, measured on the way; every step size and noise is a lane of its own."""
    piece, env = bench.piece, bench.env("training")
    own = dataclasses.replace(
        bench.config,
        task=bench.world,
        sizes=bench.set("sizes.", bench.config.sizes),
        agent=bench.set("agent.", bench.config.agent),
        scalars=bench.set("scalars.", bench.config.scalars),
        schedule=bench.set("schedule.", dataclasses.replace(bench.config.schedule, learn_after=1_000)),
    )
    lanes = every(len(bench.seeds), range(piece.seeds), piece.rates, piece.noises_deg)
    tuning = FineTuning(own, env, bench.agents, lanes)
    shown = bench.env(piece.split)
    settings = {"learning_rate": lanes.learning_rate, "noise_deg": lanes.noise_deg}
    settings |= {"base": bench.seeds[lanes.base], "label_seed": lanes.seed}
    while True:
        failed = tuning.failed.astype(float)
        metrics = bench.measured(tuning.policy(shown))
        yield {**settings, "labels": 0, "steps": tuning.step, "failed": failed, **metrics}
        if tuning.step >= piece.steps:
            return
        tuning.train(piece.every)


def _kind(name: str) -> Callable[[Bench], Iterator[Row]]:
    return lambda bench: by_labels(guidances.find(bench.piece.settings.get("guidance", name)), bench)


def read(bench: Bench) -> Iterator[Row]:
    """Read answers, which also decide. The control `SHUFFLED` uses answers of other rows."""
    piece, env = bench.piece, bench.env("training")
    kind, scalars = guidances.find("reading"), by_reading.settling(bench.scalars(), None)
    guidance = kind.make(by_model.SIZES, spaces_of(env), None)
    lanes = product(len(bench.seeds), range(piece.seeds), piece.labels, (actions_of(env).reach,))
    family = declared_distortions(env)
    of = by_reading.ReadingAdaptation(guidance, by_model.SIZES, scalars, env, bench.agents, family)
    how = Judging(None, by=LABELS)
    found = by_reading.adapt(of, lanes, how, bench.task.make_teacher(bench.world, env))
    if piece.variant == SHUFFLED:
        found = by_reading.adapt(of, lanes, how, labels=shuffled(found.block.labels))
    which = {"base": bench.seeds[lanes.base], "label_seed": lanes.seed, "labels": lanes.budget}
    told = {"used": found.judged.used.astype(float), "rewarded_steps": 0.0}
    yield {**which, "steps": 0, **told, **bench.measured(found.policy(bench.env(piece.split)))}


def shuffled(labels: Label) -> Label:
    """Labels (lanes, slots, ...) with answers of other rows of their lane."""
    random, answers = np.random.default_rng(0), np.array(labels.answer)
    for lane, valid in enumerate(np.asarray(labels.valid)):
        rows = np.flatnonzero(valid)
        answers[lane, rows] = answers[lane, random.permutation(rows)]
    return labels.replace(answer=jnp.asarray(answers))


def coached(bench: Bench) -> Iterator[Row]:
    """Deep COACH of a correction that begins at nothing."""
    yield from by_labels(coach.KIND, bench)


METHODS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "none": measured_as_they_are,
    "teacher": corrected,
    "relative": _kind("relative"),
    "intent": _kind("intent"),
    "reading": read,
    "dcoach": coached,
    "residual": by_residuals,
    "finetuning": fine_tuned,
}
