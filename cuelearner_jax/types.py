"""Every record that flows through the system, with the shape and unit of each field.

Records describe one sample or one seed; leading axes appear only where code is vmapped.
Directions are unit vectors in the plane; angles are radians, counterclockwise positive.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, runtime_checkable

from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Params = Any  # a Flax parameter pytree
EnvState = Any  # whatever pytree an environment carries from step to step


class Step(struct.PyTreeNode):
    """What one environment step returns."""

    obs: Float[Array, " obs"]  # to act on next: after the automatic reset where the episode ended
    final_obs: Float[Array, " obs"]  # what the action led to: before the automatic reset
    aftermath: Float[Array, " aftermath"]  # what replay keeps of `final_obs`, see `Environment.recall_next`
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]  # the task ended: nothing follows
    truncated: Bool[Array, ""]  # time ran out: something would have followed
    metrics: Mapping[str, Float[Array, ""]]  # averaged over steps in every report
    outcome: Mapping[str, Float[Array, ""]]  # averaged over episodes: counts where an episode ends


@runtime_checkable
class Teacher(Protocol):
    """Knows (or believes it knows) the best action. A pytree, like an environment."""

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """The action that the teacher would choose."""
        ...


@runtime_checkable
class ValuesDirections(Protocol):
    """A teacher that holds more than one action for good, and so knows the way to the nearest."""

    def nearest_good(
        self,
        state: EnvState,
        obs: Float[Array, " obs"],
        action: Float[Array, " action"],
        spread: Float[Array, ""] | float,
        share: Float[Array, ""] | float,
    ) -> Float[Array, " action"]:
        """Of the actions worth at least a share of the best, averaged over an error of aim, the nearest to `action`.

        `spread` is the standard deviation of the aim [rad]; see `spaces.directions.nearest_direction`.
        """
        ...


@runtime_checkable
class Policy(Protocol):
    """Anything that acts. A pytree, like an environment; see `policies`."""

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Actions in n situations; `states` are what a teacher may look at, and what no agent does."""
        ...


class StoredStep(struct.PyTreeNode):
    """One step in replay, as small as the environment can make it."""

    obs: Float[Array, " memory"]  # see `Environment.remember`
    action: Float[Array, " action"]  # as executed
    reward: Float[Array, ""]
    discount: Float[Array, " 1_or_0"]  # this and the next two have no entries where nothing bootstraps
    ended: Float[Array, " 1_or_0"]  # 1 where the episode ended, terminated or truncated
    aftermath: Float[Array, " aftermath_or_0"]  # see `Environment.recall_next`


class Transition(struct.PyTreeNode):
    """One step to learn from. `next_obs` has no entries where nothing bootstraps from it (discount 0)."""

    obs: Float[Array, " obs"]
    action: Float[Array, " action"]  # as executed
    reward: Float[Array, ""]
    discount: Float[Array, ""]  # of `next_obs`: 0 at termination, never at truncation; 1 after one step
    next_obs: Float[Array, " obs_or_0"]


class Label(struct.PyTreeNode):
    """One answer of a teacher: what it said, not what a network is to predict of it (`Guide.target`)."""

    obs: Float[Array, " obs"]
    action: Float[Array, " action"]  # the action asked about
    answer: Float[Array, " answer"]  # in its form's words; relative: h in {-1, 0, +1}, see `guidance.answers`
    valid: Bool[Array, ""]  # False: padding, past this lane's budget, or no answer
    base: Float[Array, " action"] | None = None  # what was proposed before any correction; None: no model looks at it


class GuidanceModel(struct.PyTreeNode):
    """A guidance's learned part."""

    params: Params
    fitted: Bool[Array, ""]  # False until labels have been fitted: the model then leaves actions alone


class GuideState(struct.PyTreeNode):
    """The guide's part of a lane: its model, the answers so far, and the situation in which it asks next."""

    model: GuidanceModel
    labels: Label  # leading axis: slots, the largest budget of the sweep in whole rounds
    budget: Int[Array, ""]  # labels that this lane may use
    asked: Int[Array, ""]  # questions so far that count within it, answered or not
    env: EnvState  # leading axis: candidates, where each question is chosen among several situations
    obs: Float[Array, "*candidates obs"]


class AgentState(struct.PyTreeNode):
    """The agent's part of a lane: what it learns, what it has met, and where it stands."""

    params: Params  # with which it acts
    training: Any  # what learning keeps beside them, such as a target network and the optimiser's state
    replay: Float[Array, "capacity width"]
    env: EnvState  # leading axis: num_envs
    obs: Float[Array, "num_envs obs"]


class TrainState(struct.PyTreeNode):
    """One lane's everything: a lane is one seed with one label budget."""

    agent: AgentState
    guide: GuideState
    arbiter: Any  # in which environments the guide's action is executed; see `arbiters.protocol`
    key: PRNGKeyArray
    failed: Bool[Array, ""]  # did a loss, a gradient or a parameter stop being finite? It stays as it was before then


class Sketch(NamedTuple):
    """A situation as lines for a browser: SVG in a frame of its own, [m], y down.

    Colours that hang on light or dark are the page's: `var(--floor)`, `var(--solid)`, `var(--low)`, `var(--ink)`,
    `var(--free)`, `var(--hit)`, `var(--goal)`, `var(--body)`.
    """

    box: tuple[float, float, float, float]  # left, top, width, height of what is shown [m]
    still: str  # elements of what stays as it is while an action is executed
    movers: dict[str, str]  # elements of what moves, by name, drawn round (0, 0) and heading along +x
    places: dict[str, tuple[float, float, float]]  # where they are: x, y [m], turn on the screen, clockwise [deg]
    foot: tuple[float, float]  # where the arrow of an action begins [m]
    reach: tuple[float, float]  # from there: beginning and end of that arrow [m]
    turn: float  # counterclockwise angle on the screen of an action of angle 0 [deg]
    aim: float = 0.0  # length of a thin line that goes on from the arrow [m]
    words: str = ""  # about the situation, in a few words


class Reel(NamedTuple):
    """What an action leads to, as places of a sketch's movers."""

    period: float  # between two frames [s]
    frames: list[dict[str, tuple[float, float, float] | None]]  # of each mover, as `Sketch.places`; None: not seen
    words: str = ""  # how it ended


class Clock(struct.PyTreeNode):
    """Counters shared by all lanes: never vmapped, so that branches on them stay branches."""

    step: Int[Array, ""]  # environment steps of each lane
    update: Int[Array, ""]  # gradient steps of each lane
    round: Int[Array, ""]  # label rounds of each lane


class Stream(IntEnum):
    """Streams of random numbers of one lane, each folded into the lane's key before a counter is."""

    INIT = 0
    ASK = 1
    FIT = 2
    TRAIN = 3
    WALK = 4
    SHUFFLE = 5
