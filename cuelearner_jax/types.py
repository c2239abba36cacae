"""Records that environments, teachers, policies and guides exchange, with the shape and unit of each field.

Records describe one sample or one seed; leading axes appear only where code is vmapped.
Directions are unit vectors in the plane; angles are radians, counterclockwise positive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

Params = Any  # a Flax parameter pytree
EnvState = Any  # the pytree that an environment carries from step to step
Observation = Float[Array, " obs"]
Action = Float[Array, " action"]
Observations = Float[Array, "n obs"]
Actions = Float[Array, "n action"]
Number = Float[Array, ""] | float


class Step(struct.PyTreeNode):
    """The result of one environment step."""

    obs: Observation  # the next observation: after the automatic reset where the episode ended
    final_obs: Observation  # the action's result: before the automatic reset
    aftermath: Float[Array, " aftermath"]  # what replay stores of `final_obs`, see `Environment.recall_next`
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]  # the task ended: no value follows
    truncated: Bool[Array, ""]  # time ran out: values would have followed
    metrics: Mapping[str, Float[Array, ""]]  # averaged over steps in every report
    outcome: Mapping[str, Float[Array, ""]]  # averaged over episodes: counts where an episode ends


@runtime_checkable
class Teacher(Protocol):
    """A teacher: it returns an action that it holds for the best. A pytree, like an environment."""

    def best_action(self, state: EnvState, obs: Observation) -> Action:
        """Return the action that the teacher would choose."""
        ...


@runtime_checkable
class ValuesDirections(Protocol):
    """A teacher that values all directions, and so can name the nearest good one."""

    def nearest_good(self, state: EnvState, obs: Observation, action: Action, spread: Number, share: Number) -> Action:
        """Return the good action nearest to `action`: its value is at least a `share` of the best.

        `spread` is the standard deviation of the aim [rad]; see `spaces.directions.nearest_direction`.
        """
        ...


@runtime_checkable
class Policy(Protocol):
    """A policy: a pytree that acts, like an environment; see `policies`."""

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return actions in n situations; `states` are for teachers, and no agent uses them."""
        ...


class Label(struct.PyTreeNode):
    """One answer of a teacher as given, not a network's target (`Guide.target`)."""

    obs: Observation
    action: Action  # the action asked about
    answer: Float[Array, " answer"]  # by its form; relative: h in {-1, 0, +1}, see `feedback.answers`
    valid: Bool[Array, ""]  # False: padding, past this lane's budget, or no answer
    base: Action | None = None  # the uncorrected action; None: no model uses it


class GuidanceModel(struct.PyTreeNode):
    """The learned part of a guide."""

    params: Params
    fitted: Bool[Array, ""]  # False until labels have been fitted; until then actions are not changed


class Sketch(NamedTuple):
    """A situation as lines or a picture for a browser: SVG in a frame of its own, y down [m; pixels of a picture].

    Colours that depend on light or dark mode are the page's: `var(--floor)`, `var(--solid)`, `var(--low)`,
    `var(--ink)`, `var(--free)`, `var(--hit)`, `var(--goal)`, `var(--body)`.
    """

    box: tuple[float, float, float, float]  # left, top, width, height of what is shown [m]
    still: str  # SVG elements that do not move while an action is executed
    movers: dict[str, str]  # SVG elements that move, by name, drawn around (0, 0) and heading along +x
    places: dict[str, tuple[float, float, float]]  # place of each: x, y [m], turn on the screen, clockwise [deg]
    foot: tuple[float, float]  # where the arrow of an action begins [m]
    reach: tuple[float, float]  # distances of the arrow's beginning and end from there [m]
    turn: float  # counterclockwise angle on the screen of an action of angle 0 [deg]
    aim: float = 0.0  # length of a thin line that goes on from the arrow [m]
    words: str = ""  # about the situation, in a few words
    # Of each cue, which way more of it points on the screen: x to the right, y down; None: nowhere. None given: by the
    # words of the cues (`labelling.view`)
    points: tuple[tuple[float, float] | None, ...] = ()


class Reel(NamedTuple):
    """The consequence of an action: places of a sketch's movers, or pictures that replace the sketch's picture."""

    period: float  # between two frames [s]
    frames: list[dict[str, tuple[float, float, float] | None]]  # place of each mover, as `Sketch.places`; None: hidden
    words: str = ""  # how the film ended
    pictures: Sequence[str] = ()  # one a frame, as data URIs; see `pictures.clip`
