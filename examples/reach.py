"""A task of one's own in one file: a boat crosses a lake to a buoy, and a wind carries it off.

The wind is another in each episode. The reward is 1 at the buoy and 0 before, so that chance seldom finds it. Run in
the folder above this one:

    cuelearner sweep examples.reach:TASK --preset quickstart --out runs/reach
    cuelearner report runs/reach --out runs/reach/report --metric success
    cuelearner evaluate runs/reach --task examples.reach:TASK --scenario storm
    cuelearner render runs/reach --task examples.reach:TASK --steps 40 --out pictures
    cuelearner render runs/reach --task examples.reach:TASK --question --out pictures

One seed of it: `cuelearner train examples.reach:TASK --preset quickstart --out runs/reach-one`. People label it in a
browser: `cuelearner label examples.reach:TASK --out labels/reach`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cuelearner_envs import svg
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.config import EPISODE, Bounds, Scalars, Schedule, Sizes, check_part
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.pictures import palette_of, write_film
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces.directions import from_angle, retract, rotate
from cuelearner_jax.task import Body, Pictures, Preset, Scenario, Task
from cuelearner_jax.types import Policy, Reel, Sketch, Step

PERIOD = 0.1  # of a step [s]
FILM = 20  # steps that the film on the labelling page shows
GOAL_RADIUS = 0.08  # nearer than this, the buoy is reached [m]
BOAT, BUOY, WIND, ARROW, WATER = "#0072B2", "#009E73", "#7f7f7f", "#E69F00", "#f3f8fb"


# ---------------------------------------------------------------------------------------------- the environment


@dataclass(frozen=True)
class ReachConfig:
    """A lake and the boat on it. Every field is an option `--task.…`, its docstring is the help."""

    wind: Annotated[float, Bounds(0)] = 0.5
    """Speed of the wind's drift [m/s]; its direction changes with every episode."""
    speed: Annotated[float, Bounds(0)] = 1.0
    """Speed of the boat through the water [m/s]."""
    rudder_deg: float = 0.0
    """Changed world: the boat's heading is rotated counterclockwise by this angle [deg]."""
    max_steps: Annotated[int, EPISODE] = 40
    """Steps of 0.1 s after which an episode is truncated."""
    mirrors: bool = False
    """Add the quarter turns of labels and transitions to the data, whatever the guidance."""


class Boat(struct.PyTreeNode):
    """State between steps."""

    place: Float[Array, "2"]  # [m]; an episode begins at 0, 0
    buoy: Float[Array, "2"]  # [m]
    wind: Float[Array, "2"]  # the drift's velocity [m/s]
    steps: Int[Array, ""]  # taken in this episode


class Reach(WholeObservations, struct.PyTreeNode):
    """The environment. Fields are traced: another wind or rudder needs no new compile."""

    wind: Float[Array, ""]  # [m/s]
    speed: Float[Array, ""]  # [m/s]
    rudder: Float[Array, ""]  # [rad]
    max_steps: Int[Array, ""]
    mirrors: bool = struct.field(pytree_node=False, default=False)

    observation = (
        Quantity("buoy", 2, "m", "x, y from the boat"),
        Quantity("wind", 2, "m/s", "x, y of its drift"),
    )

    def reset(self, key: PRNGKeyArray) -> tuple[Boat, Float[Array, "4"]]:
        """Start with a buoy 1 to 1.5 m away and a wind, each in a random direction."""
        k_far, k_buoy, k_wind = jax.random.split(key, 3)
        far = jax.random.uniform(k_far, (), minval=1.0, maxval=1.5)
        towards, blowing = (from_angle(jax.random.uniform(k, (), maxval=2 * jnp.pi)) for k in (k_buoy, k_wind))
        boat = Boat(jnp.zeros(2), far * towards, self.wind * blowing, jnp.zeros((), jnp.int32))
        return boat, self.observe(boat)

    def step(self, key: PRNGKeyArray, state: Boat, action: Float[Array, "2"]) -> tuple[Boat, Step]:
        """Sail for one period; a new episode follows an end."""
        after = self.moved(state, action)
        reached = jnp.linalg.norm(after.buoy - after.place) < GOAL_RADIUS
        late = (after.steps >= self.max_steps) & ~reached
        success = reached.astype(jnp.float32)
        outcome = {"success": success, "duration": after.steps * PERIOD}
        return self.step_to(key, after, reward=success, terminated=reached, truncated=late, metrics={}, outcome=outcome)

    def moved(self, state: Boat, action: Float[Array, "2"]) -> Boat:
        """Return the state after a step, without a reset."""
        velocity = self.speed * rotate(action, self.rudder) + state.wind
        return state.replace(place=state.place + PERIOD * velocity, steps=state.steps + 1)

    def observe(self, state: Boat) -> Float[Array, "4"]:
        """Return the observation (4,): buoy from the boat [m], wind [m/s]."""
        return jnp.concatenate([state.buoy - state.place, state.wind])

    def heuristic(self, obs: Float[Array, "4"]) -> Float[Array, "2"]:
        """Head straight for the buoy, whatever the wind; this action makes `--guidance heuristic` possible."""
        return retract(obs[:2])

    @property
    def symmetries(self) -> int:
        """Number of symmetries: the quarter turns of the lake."""
        return 4 if self.mirrors else 1

    def mirror(
        self, which: Int[Array, ""], obs: Float[Array, "4"], vector: Float[Array, "2"]
    ) -> tuple[Float[Array, "4"], Float[Array, "2"]]:
        """Rotate buoy, wind and action together by a number of quarter turns."""
        turn = which * (jnp.pi / 2)
        return rotate(obs.reshape(2, 2), turn).ravel(), rotate(vector, turn)


def make_environment(config: ReachConfig, split: str = "training") -> Reach:
    """Return the environment of a configuration; splits need not differ, since episodes are random."""
    check_part(config, "task")
    return Reach(
        wind=jnp.float32(config.wind),
        speed=jnp.float32(config.speed),
        rudder=jnp.deg2rad(jnp.float32(config.rudder_deg)),
        max_steps=jnp.int32(config.max_steps),
        mirrors=config.mirrors,
    )


# -------------------------------------------------------------------------------------------------- the teacher


class Skipper(struct.PyTreeNode):
    """A teacher that knows the wind: it heads so far into it that the boat makes straight for the buoy."""

    env: Reach

    def best_action(self, state: Boat, obs: Float[Array, "4"]) -> Float[Array, "2"]:
        """Return the heading whose part across the way cancels the wind's drift."""
        along = retract(state.buoy - state.place)
        across = rotate(along, jnp.pi / 2)
        into = jnp.clip(-jnp.dot(state.wind, across) / self.env.speed, -1.0, 1.0)
        heading = into * across + jnp.sqrt(1.0 - into**2) * along
        return rotate(heading, -self.env.rudder)


# -------------------------------------------------------------------------------------------------- the pictures


class Frame(NamedTuple):
    """One step of an episode, in NumPy arrays."""

    place: np.ndarray  # before the step [m]
    after: np.ndarray  # and after it
    buoy: np.ndarray  # [m]
    wind: np.ndarray  # [m/s]
    action: np.ndarray
    ended: str  # "reached" or "out of time" where the episode ended


def record(env: Reach, policy: Policy, key: PRNGKeyArray, steps: int) -> tuple[list[Frame], list[float]]:
    """Return frames and rewards of some steps of a policy, over several episodes if needed."""

    @jax.jit
    def play(env: Reach, key: PRNGKeyArray) -> Any:
        k_reset, k_play = jax.random.split(key)

        def advance(carry: Any, number: jax.Array) -> Any:
            state, obs = carry
            k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
            states = jax.tree.map(lambda leaf: leaf[None], state)
            action = policy.act(k_act, states, obs[None])[0]
            following, step = env.step(k_step, state, action)
            after = env.moved(state, action).place
            return (following, step.obs), (state, action, after, step)

        return jax.lax.scan(advance, env.reset(k_reset), jnp.arange(steps))[1]

    states, actions, after, taken = jax.device_get(play(env, key))
    ends = np.where(taken.terminated, "reached", np.where(taken.truncated, "out of time", ""))
    rows = zip(states.place, after, states.buoy, states.wind, actions, map(str, ends), strict=True)
    return [Frame(*row) for row in rows], [float(reward) for reward in taken.reward]


def still(env: Reach, frames: list[Frame], file: Path) -> None:
    """Write a picture of the first episode's path and chosen directions."""
    last = next((number for number, frame in enumerate(frames) if frame.ended), len(frames) - 1)
    _drawn(frames[: last + 1], "chosen").savefig(file)


def animate(env: Reach, frames: list[Frame], file: Path) -> None:
    """Write a film of all episodes, one picture per step."""

    def pictures(rate: float) -> Iterator[np.ndarray]:
        way: list[Frame] = []
        for frame in frames:
            way = [frame] if way and way[-1].ended else [*way, frame]
            yield _pixels(way)
            for _ in range(round(0.6 * rate) if frame.ended else 0):  # the end stands for a moment
                yield _pixels(way)

    palette = palette_of(_pixels(frames[:1]), 100, (BOAT, BUOY, WIND, ARROW, WATER, "#ffffff"))
    write_film(file, 10.0, pictures, palette)


def question(env: Reach, state: Boat, obs: Float[Array, "4"], action: Float[Array, "2"], file: Path) -> None:
    """Write the situation with the asked action, as the labelling page shows it."""
    seen = jax.device_get(state)
    frame = Frame(seen.place, seen.place, seen.buoy, seen.wind, np.asarray(action), "")
    _drawn([frame], "in question").savefig(file)


def _drawn(way: list[Frame], arrow: str) -> Figure:
    """Draw an episode's steps so far on the lake, the latest action as an arrow."""
    figure = Figure(figsize=(4.8, 4.8), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), facecolor=WATER, xlim=(-1.8, 1.8), ylim=(-1.8, 1.8), aspect="equal")
    axes.set(xticks=[], yticks=[])
    latest = way[-1]
    corner, pointing = np.array([-1.4, 1.4]), {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.008}
    axes.quiver(*(corner - 0.3 * latest.wind), *(0.6 * latest.wind), color=WIND, **pointing)
    axes.text(corner[0], corner[1] - 0.25, f"wind {np.linalg.norm(latest.wind):.1f} m/s", color=WIND, ha="center")
    axes.plot(*latest.buoy, "o", color=BUOY, markersize=14)
    axes.plot(*np.stack([way[0].place, *(frame.after for frame in way)]).T, color=BOAT, linewidth=2)
    axes.plot(*latest.after, "o", color=BOAT, markersize=9)
    axes.quiver(*latest.place, *(0.35 * latest.action), color=ARROW, zorder=3, **pointing)
    seconds, ended = PERIOD * len(way), latest.ended or "under way"
    told = f"{ended}, {seconds:.1f} s" if latest.after is not latest.place else "buoy: green, boat: blue"
    axes.text(0.0, -1.72, f"{told}; arrow: direction {arrow}", ha="center")
    return figure


def _pixels(way: list[Frame]) -> np.ndarray:
    canvas: Any = _drawn(way, "chosen").canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


# ------------------------------------------------------------------------------------------- the labelling page


def sketch(env: Reach, state: Boat) -> Sketch:
    """Return the lake as a sketch for the labelling page (y points down), with boat and buoy in view."""
    boat, buoy, wind = (np.asarray(each, float) * [1, -1] for each in (state.place, state.buoy, state.wind))
    half = max(1.4, 0.5 + 0.6 * float(np.linalg.norm(buoy - boat)))
    left, top = (boat + buoy) / 2 - half
    lake = svg.rectangle(left - half, top - half, 4 * half, 4 * half, "fill:var(--floor)")
    ring = svg.circle(tuple(buoy), GOAL_RADIUS, "fill:var(--goal)")
    corner = np.array([left, top]) + 0.35
    way = svg.points([corner - 0.25 * wind, corner + 0.25 * wind])
    blows = svg.element("polyline", points=way, style="fill:none;stroke:var(--low);stroke-width:0.02")
    head = svg.circle(tuple(corner + 0.25 * wind), 0.03, "fill:var(--low)")  # where the wind blows to
    told = svg.text((corner[0] - 0.15, corner[1] + 0.35), 0.09, "wind, to the dot", "fill:var(--ink)", "start")
    return Sketch(
        box=(left, top, 2 * half, 2 * half),
        still=lake + ring + blows + head + told,
        movers={"boat": svg.polygon([(0.09, 0.0), (-0.06, 0.05), (-0.06, -0.05)], "fill:var(--body)")},
        places={"boat": (*boat, 0.0)},
        foot=tuple(boat),
        reach=(0.11, 0.45),
        turn=0.0,
        aim=0.5,
        words=f"{np.linalg.norm(buoy - boat):.1f} m from the buoy, wind {np.linalg.norm(wind):.1f} m/s",
    )


def reel(env: Reach, state: Boat, action: Float[Array, "2"]) -> Reel:
    """Return the boat's path if the same action is repeated."""
    frames, heading = [], -np.degrees(np.arctan2(*np.asarray(action)[::-1]))
    for _ in range(FILM):
        frames.append({"boat": (float(state.place[0]), -float(state.place[1]), float(heading))})
        if jnp.linalg.norm(state.buoy - state.place) < GOAL_RADIUS:
            return Reel(PERIOD, frames, "the buoy is reached")
        state = env.moved(state, action)
    return Reel(PERIOD, frames, f"after {PERIOD * FILM:.0f} s: not there")


# ------------------------------------------------------------------------------------------------------ the task


def _pictures() -> Pictures:
    return Pictures(record=record, still=still, animate=animate, question=question, sketch=sketch, reel=reel)


TASK = Task(
    name="reach",
    about="reach a buoy in a cross wind",
    wants=lambda config: "The boat goes where the arrow points, the wind pushes it; it wants to get to the green buoy.",
    config=ReachConfig,
    bodies=(Body("boat", "goes where it is sent, and with the wind", make_environment, pictures=_pictures),),
    teacher=lambda config, env: Skipper(env),
    longest=lambda config: config.max_steps,
    scenarios={
        "storm": Scenario("a wind that the boat barely makes way against", {"wind": 0.75}, bound_deg=60.0),
        "bent_rudder": Scenario("the boat heads 25 degrees too far left", {"rudder_deg": 25.0}, bound_deg=60.0),
    },
    presets={
        "quickstart": Preset(
            "guided and unguided, four seeds: seconds on two CPU cores",
            RunConfig(
                ReachConfig(mirrors=True),
                Sizes(feedback_layers=(64, 64), num_envs=10, fit_steps=600, fit_batch_size=64),
                Scalars(feedback_learning_rate=0.005, discount=0.9, max_grad_norm=10.0, eps_deg=40.0),
                Schedule(
                    total_steps=3_000,
                    random_steps=200,
                    learn_after=200,
                    guidance_until=1_500,
                    eval_every=500,
                    eval_steps=8_000,
                    eval_envs=200,
                    checkpoint_every=1_500,
                ),
                ddqn.DDQNConfig(
                    q_layers=(64, 64),
                    directions=36,
                    target_directions=12,
                    batch_size=64,
                    replay_capacity=20_000,
                    optimizer="adam",
                    learning_rate=0.003,
                    polyak=0.05,
                ),
                Paced(),
            ),
            guidance=("none", "relative"),
            labels=(100,),
            seeds=4,
        )
    },
)
