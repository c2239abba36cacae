"""Train the quadruped's walking policy by brax's PPO, or measure one in MJX and in C MuJoCo.

    python experiments/train_walking.py train --out runs/anymal-policy --train.seconds 270   # minutes on an accelerator
    python experiments/train_walking.py evaluate [FOLDER]                                    # default: the shipped one

The shipped policy was made so (`envs/cuelearner_envs/anymal`). The folder of a policy always holds the newest one
measured, with its history: a run that is cut leaves it.
"""

from __future__ import annotations

import json
import math
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from cuelearner_envs.anymal import policy, tracking
from cuelearner_envs.anymal.locomotion import Locomotion
from cuelearner_jax import config as configuration
from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.config import Bounds, Layers
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.storage.folders import claimed, in_use
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.terminal import Interrupted, interruptible

COLUMNS = ("steps", "wall_s", "error", "turning_error", "falls")  # of the history
VALUE_LAYERS = (256, 256, 256, 256)
Tell = Callable[[str], None]


Positive = Bounds(0, math.inf, above=True)
Robots = Annotated[int, Bounds(1, 1 << 20)]  # each keeps some kilobytes of physics


@dataclass(frozen=True)
class Training:
    """Settings of training to walk (brax's PPO)."""

    steps: Annotated[int, Bounds(1)] = 100_000_000
    """Steps of control, over all robots."""
    seconds: Annotated[float, Bounds(0)] = 0.0
    """Stop at the first measurement after this time [s]; 0: only after all steps."""
    robots: Robots = 4096
    """Robots that walk in parallel."""
    layers: Layers = (256, 128, 64)
    """Hidden layers of the policy."""
    unroll: Annotated[int, Bounds(1)] = 20
    """Steps of control in a piece of experience."""
    minibatches: Annotated[int, Bounds(1)] = 16
    """Parts into which a batch is split."""
    batch_size: Annotated[int, Bounds(1)] = 256
    """Pieces of experience in a minibatch; times minibatches it must be a multiple of the robots."""
    updates: Annotated[int, Bounds(1)] = 4
    """Passes over each batch."""
    learning_rate: Annotated[float, Positive] = 3e-4
    """Adam's step size."""
    entropy: Annotated[float, Bounds(0)] = 0.01
    """Weight of the policy's entropy."""
    discount: Annotated[float, Positive] = 0.97
    """Discount factor."""
    max_grad_norm: Annotated[float, Positive] = 1.0
    """Bound on the gradient's norm."""
    episode: Annotated[int, Bounds(1)] = 1000
    """Steps of control of an episode."""
    measurements: Annotated[int, Bounds(1)] = 20
    """Times at which the policy is measured and saved."""
    measured_robots: Robots = 512
    """Robots that a measurement watches for 20 s."""


@dataclass(frozen=True)
class Train:
    """Train the quadruped's walking policy."""

    out: Path = Path("runs/anymal-policy")
    """Folder for the policy."""
    train: Training = field(default_factory=Training)
    seed: int = 0
    """Seed."""


@dataclass(frozen=True)
class Evaluate:
    """Measure a walking policy in MJX and in C MuJoCo."""

    policy: tyro.conf.Positional[Path | None] = None
    """Folder of a policy (default: the shipped one)."""
    robots: int = 512
    """Robots that walk for 20 s in each trial."""
    seed: int = 1
    """Decides commands, grounds, noise and pushes."""
    out: Path | None = None
    """Also write the figures to this JSON file."""


class _Enough(Exception):
    """The time is over, or somebody asked to stop."""


def train(config: Training, out: Path, seed: int, command: str, tell: Tell = print) -> dict[str, Any]:
    """Train a walking policy, measure it and write it.

    Returns:
        What is written beside it: settings, history, figures.

    Raises:
        UserError: bad configuration, or a folder in use; nothing has been changed then.
        Interrupted: Ctrl-C or SIGTERM; the newest measured policy is saved.
        NotFinite: the training diverged; the newest measured policy that was finite is saved.
    """
    configuration.check_part(config, "train")
    pieces, name = config.batch_size * config.minibatches, "train.batch_size times train.minibatches"
    configuration.check_multiple(pieces, config.robots, name, "train.robots")
    if in_use(out):
        raise UserError(f"{out} is not empty: give another --out")
    about = {"config": configuration.to_json(config), "seed": seed, **provenance(), "command": command}
    rows: list[list[float]] = []
    about["history"] = {"columns": list(COLUMNS), "rows": rows}
    key, began = jax.random.key(seed), time.perf_counter()

    def look(steps: int, _: Any, params: Any) -> None:
        if not all_finite(params):
            held = "holds the policy of the measurement before" if rows and rows[-1][0] else "holds no policy"
            raise NotFinite(
                f"the walking policy is no longer finite by step {steps:,}, and was not written; {out} {held}: train "
                "with a smaller --train.learning-rate and another --out"
            )
        walk, k_measure = policy.from_brax(params), jax.random.fold_in(key, 0)
        figures = tracking.measure(walk, "mjx", tracking.TRIALS["clean"], k_measure, config.measured_robots)
        wall = time.perf_counter() - began
        rows.append([steps, round(wall, 1), *(round(figures[name], 4) for name in COLUMNS[2:])])
        tell(
            f"{wall:6.0f} s {steps / 1e6:7.1f}M steps   error {figures['error']:.3f} m/s, "
            f"turning {figures['turning_error']:.3f} rad/s, falls {figures['falls']:.1%}"
        )
        if steps:  # what is still untrained is not worth keeping
            policy.save(out, jax.device_get(walk), {**about, "finished": False})
        if stopping.is_set() or (steps and config.seconds and wall > config.seconds):
            raise _Enough

    tell(f"{jax.devices()[0].device_kind}: compiling takes a minute or so")
    with claimed(out), interruptible("the next measurement") as stopping:
        try:
            _ppo(config, seed, look)
        except _Enough:
            if stopping.is_set():
                held = f"{out} holds the policy of the last measurement" if rows[-1][0] else "nothing was learned yet"
                raise Interrupted(f"stopped; {held}") from None
        trained = {"trained_steps": rows[-1][0], "training_s": round(time.perf_counter() - began, 1)}
        figures = _examined(policy.load(out), jax.random.fold_in(key, 1), config.measured_robots, tell)
        about |= {"finished": True, **trained, "figures": figures}
        policy.save(out, policy.load(out), about)
    return about


def evaluate(options: Evaluate, command: str) -> None:
    """Measure a policy trial by trial; write the figures to `options.out`, if given. Raises UserError if it exists."""
    if options.robots < 1:
        raise UserError(f"--robots is {options.robots}: give a positive number")
    if options.out and options.out.exists():
        raise UserError(f"{options.out} exists: give another --out")
    walk = policy.load(options.policy) if options.policy else policy.load()
    figures = _examined(walk, jax.random.key(options.seed), options.robots, print)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        contents = {"seed": options.seed, **provenance(), "command": command, "figures": figures}
        options.out.write_text(json.dumps(contents, indent=1) + "\n")


def _ppo(config: Training, seed: int, look: Callable[[int, Any, Any], None]) -> None:
    """brax's PPO with the settings; `look` is called now and then with (steps, _, parameters)."""
    from brax.training.agents.ppo import networks  # takes seconds to load
    from brax.training.agents.ppo import train as ppo

    if not hasattr(jax, "device_put_replicated"):  # PPO of brax 0.14.2 calls it, here for one device; JAX 0.10 lacks it
        stacked = lambda tree, devices: jax.tree.map(lambda leaf: jax.numpy.asarray(leaf)[None], tree)  # noqa: E731
        setattr(jax, "device_put_replicated", stacked)  # noqa: B010 (the type checker knows no such name)
    ppo.train(
        environment=Locomotion(),
        num_timesteps=config.steps,
        max_devices_per_host=1,
        num_envs=config.robots,
        episode_length=config.episode,
        learning_rate=config.learning_rate,
        entropy_cost=config.entropy,
        discounting=config.discount,
        unroll_length=config.unroll,
        batch_size=config.batch_size,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.updates,
        normalize_observations=True,
        max_grad_norm=config.max_grad_norm,
        network_factory=partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=config.layers, value_hidden_layer_sizes=VALUE_LAYERS
        ),
        seed=seed,
        num_evals=config.measurements + 1,
        num_eval_envs=1,
        run_evals=False,  # its evaluation is another compile and knows nothing of settled errors
        policy_params_fn=look,
    )


def _examined(walk: Any, key: jax.Array, robots: int, tell: Tell) -> dict[str, dict[str, float]]:
    """Figures of a policy by trial, each told as soon as it is measured."""
    figures = {}
    tell(f"{robots} robots walk for 20 s, trial by trial")
    for name, values in tracking.examine(walk, key, robots):
        figures[name] = {figure: round(value, 5) for figure, value in values.items()}
        tell(f"{name:20}" + ", ".join(f"{figure} {value:.4g}" for figure, value in figures[name].items()))
    return figures


def main(arguments: list[str] | None = None) -> int:
    """Read the arguments, then train or evaluate; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = tyro.cli(Train | Evaluate, args=arguments, prog=Path(__file__).name, description=__doc__)
    command = shlex.join(["python", f"experiments/{Path(__file__).name}", *arguments])
    try:
        if isinstance(options, Train):
            train(options.train, options.out, options.seed, command)
        else:
            evaluate(options, command)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (Interrupted, NotFinite) as error:
        print(error, file=sys.stderr)
        return error.status
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
