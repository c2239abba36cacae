"""What environments, teachers, policies and guides exchange, with the shape and unit of each field.

Records describe one sample or one seed; leading axes appear only where code is vmapped.
Directions are unit vectors in the plane; angles are radians, counterclockwise positive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

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


class Sketch(NamedTuple):
    """A situation as lines or a picture for a browser: SVG in a frame of its own, y down [m; pixels of a picture].

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
    # Of each cue, which way more of it points on the screen: x to the right, y down; None: nowhere. None given: by the
    # words of the cues (`labelling.pointing`)
    points: tuple[tuple[float, float] | None, ...] = ()


class Reel(NamedTuple):
    """What an action leads to, as places of a sketch's movers, or as pictures in the place of a sketch's picture."""

    period: float  # between two frames [s]
    frames: list[dict[str, tuple[float, float, float] | None]]  # of each mover, as `Sketch.places`; None: not seen
    words: str = ""  # how it ended
    pictures: Sequence[str] = ()  # one a frame, as data URIs; see `pictures.clip`
