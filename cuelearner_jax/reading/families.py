"""Families of possible changes between a policy and its world, in named unknowns, and how each change is undone.

A distortion says how observations or actions may have changed: balls are seen shifted, a lidar is mounted turned, every
strike is turned. `sees` returns the observation as it would be without the change. `acts` returns the action that,
after the change, does what the policy meant. Several distortions together are a family; with all unknowns at zero a
family changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.environment import EFFECT, PROPOSED, Quantity, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Action, Observation

AXES = ("x", "y", "z")
SHIFTING = ("m", "rad")  # units of entries that a displaced sensor shifts by a constant
PERCENT = 0.01


class Unknown(NamedTuple):
    """A number that says how large a change is; 0: no change."""

    name: str
    unit: str
    scale: float | None = None  # typical size in its unit; None: found from the policy's actions (`steps`)
    most: float = math.inf  # largest possible size, in its unit
    is_log: bool = False  # whether it is the logarithm of a factor, in percent; told as the change of the factor


Undoing = Callable[[Float[Array, " unknowns"], Float[Array, " size"]], Float[Array, " size"]]
Planning = Callable[[Float[Array, " unknowns"], Observation, Action], Action]


class Distortion(NamedTuple):
    """One way in which a world may have changed. All functions take the unknowns in their units, and one row."""

    name: str
    unknowns: tuple[Unknown, ...]
    sees: Undoing | None = None  # (unknowns, observation) -> observation before the change
    acts: Undoing | None = None  # (unknowns, meant action) -> action that leads to it after the change
    plans: Planning | None = None  # (unknowns, observation, meant action) -> the same
    effect: tuple[int, int] = (0, 0)  # first entry of the observation that `plans` alone reads, and the end of these


Family = tuple[Distortion, ...]
ACTIONS_ALONE: Family = (Distortion("actions", ()),)  # without unknowns: shift, gain and process of the actions


def unknowns_of(family: Family) -> tuple[Unknown, ...]:
    """Return all unknowns of a family, in the order of theta."""
    return tuple(unknown for distortion in family for unknown in distortion.unknowns)


def undo_observation(family: Family, theta: Float[Array, " unknowns"], obs: Observation) -> Observation:
    """Return the observation as it would have been without the changes."""
    for distortion, values in _parts(family, theta):
        obs = obs if distortion.sees is None else distortion.sees(values, obs)
    return obs


def undo_action(family: Family, theta: Float[Array, " unknowns"], obs: Observation, action: Action) -> Action:
    """Return the action that, after the changes, does what `action` did before them; `obs`: without the changes."""
    for distortion, values in _parts(family, theta):
        action = action if distortion.plans is None else distortion.plans(values, obs, action)
    for distortion, values in _parts(family, theta):
        action = action if distortion.acts is None else distortion.acts(values, action)
    return action


def _parts(family: Family, theta: Float[Array, " unknowns"]) -> list[tuple[Distortion, Float[Array, " n"]]]:
    parts, start = [], 0
    for distortion in family:
        parts.append((distortion, theta[start : start + len(distortion.unknowns)]))
        start += len(distortion.unknowns)
    return parts


def check_family(family: Sequence[Distortion]) -> Family:
    """Return a family as a tuple. Raises UserError for no distortion, one without unknowns, or two of one name."""
    if not family:
        raise UserError("changes is empty: give at least one distortion")
    names = [unknown.name for unknown in unknowns_of(tuple(family))]
    for distortion in family:
        if not distortion.unknowns:
            raise UserError(f"distortion {distortion.name!r} has no unknowns: give at least one")
        if distortion.sees is None and distortion.plans is None and distortion.acts is None:
            raise UserError(f"distortion {distortion.name!r} changes nothing: give `sees`, `acts` or `plans`")
    for names_of_kind in (names, [distortion.name for distortion in family]):
        if twice := sorted({name for name in names_of_kind if names_of_kind.count(name) > 1}):
            raise UserError(f"{twice[0]!r} is the name of two distortions or unknowns: give each name once")
    return tuple(family)


def declared_distortions(env: Any) -> Family:
    """Derive the distortions of what is seen from what an environment declares of its observation; empty: nothing.

    Places in metres of the same size shift together and may be scaled, and so do several angles; a slice of one entry
    shifts by itself. Beams at equal angles roll. Directions turn, and places with an `origin` turn about that. A change
    of the actions needs no declaration. Of actions that are proposed elsewhere the robot's state is seen aside where
    its effect is recorded, or else nothing: they alone may have changed.
    """
    if any(quantity.kind == PROPOSED for quantity in env.observation):
        return (_state(env),) if any(quantity.kind == EFFECT for quantity in env.observation) else ACTIONS_ALONE
    places = _places(env.observation)
    distortions: list[Distortion] = []
    for (unit, size, _), slices in _alike(places).items():
        distortions.append(_shift(unit, size, slices))
        if unit == "m":
            distortions.append(_gain(slices))
    distortions += _turned_places(places)
    distortions += [_roll(quantity, start) for quantity, start in places if quantity.kind == "beams"]
    distortions += [_turned(quantity, start) for quantity, start in places if quantity.kind == "directions"]
    return check_family(distortions) if distortions else ()


def has_effects(family: Family) -> bool:
    """Return whether a family changes proposed actions by recorded effects of the robot's state."""
    return any(one.effect[1] for one in family)


def _state(env: Any) -> Distortion:
    """Return a shift of the robot's state against what else the policy sees, by the effect of each entry."""
    (effect, start), (_, end), space = *_places(env.observation)[-2:], actions_of(env)
    names = [
        f"{one.name} {entry + 1}" if one.size > 1 else one.name for one in env.observation for entry in range(one.size)
    ]
    unknowns = tuple(Unknown(f"state {name}", "") for name in names[: effect.size // space.size])

    def plans(theta: Array, obs: Array, action: Array) -> Array:
        return space.retract(action - theta @ obs[start:end].reshape(len(theta), space.size))

    return Distortion("state", unknowns, plans=plans, effect=(start, end))


def _places(observation: Sequence[Quantity]) -> list[tuple[Quantity, int]]:
    """Return each slice with the number of its first entry."""
    starts = [sum(quantity.size for quantity in observation[:number]) for number in range(len(observation))]
    return list(zip(observation, starts, strict=True))


def _alike(places: list[tuple[Quantity, int]]) -> dict[tuple[str, int, int], list[tuple[Quantity, int]]]:
    """Return the slices that a displaced sensor shifts together: those of one unit and size, or a single entry."""
    groups: dict[tuple[str, int, int], list[tuple[Quantity, int]]] = {}
    for quantity, start in places:
        if quantity.unit in SHIFTING and not quantity.kind:
            alone = start if quantity.size == 1 else -1
            groups.setdefault((quantity.unit, quantity.size, alone), []).append((quantity, start))
    return groups


def _called(slices: list[tuple[Quantity, int]]) -> str:
    names = [quantity.name for quantity, _ in slices]
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _shift(unit: str, size: int, slices: list[tuple[Quantity, int]]) -> Distortion:
    entries = AXES[:size] if size <= len(AXES) else tuple(str(number + 1) for number in range(size))
    name = f"{_called(slices)}: shift"
    unknowns = tuple(Unknown(f"{name} {entry}" if size > 1 else name, unit) for entry in entries)
    index = jnp.array([start + number for _, start in slices for number in range(size)])

    def sees(theta: Array, obs: Array) -> Array:
        return obs - jnp.zeros(len(obs)).at[index].set(jnp.tile(theta, len(slices)))

    return Distortion(name, unknowns, sees)


def _gain(slices: list[tuple[Quantity, int]]) -> Distortion:
    index = jnp.array([start + number for quantity, start in slices for number in range(quantity.size)])

    def sees(theta: Array, obs: Array) -> Array:
        return obs * jnp.ones(len(obs)).at[index].set(jnp.exp(-PERCENT * theta[0]))

    name = f"{_called(slices)}: gain"
    return Distortion(name, (Unknown(name, "percent", most=100.0, is_log=True),), sees)


def _turn(what: str, sees: Undoing) -> Distortion:
    return Distortion(f"{what}: turn", (Unknown(f"{what}: turn", "degrees", most=180.0),), sees)


def _roll(quantity: Quantity, start: int) -> Distortion:
    if quantity.step_deg <= 0:
        raise UserError(f"slice {quantity.name!r} has beams and no angle between them: give its `step_deg`")
    ring = abs(quantity.size * quantity.step_deg - 360) < 0.5 * quantity.step_deg
    own = slice(start, start + quantity.size)

    def sees(theta: Array, obs: Array) -> Array:
        number, mode = jnp.arange(quantity.size) - theta[0] / quantity.step_deg, "wrap" if ring else "nearest"
        beams = jax.scipy.ndimage.map_coordinates(obs[own], [number], order=1, mode=mode)
        return jnp.concatenate([obs[: own.start], beams, obs[own.stop :]])

    return _turn(quantity.name, sees)


def _turned(quantity: Quantity, start: int) -> Distortion:
    if quantity.size % 2:
        raise UserError(f"slice {quantity.name!r} has {quantity.size} entries: give pairs of x and y, or no kind")
    x, y = (slice(start + entry, start + quantity.size, 2) for entry in (0, 1))

    def sees(theta: Array, obs: Array) -> Array:
        cos, sin = jnp.cos(jnp.deg2rad(theta[0])), jnp.sin(jnp.deg2rad(theta[0]))
        other = obs[jnp.arange(len(obs)).at[x].add(1).at[y].add(-1)]
        along = jnp.ones(len(obs)).at[x].set(cos).at[y].set(cos)
        return along * obs + jnp.zeros(len(obs)).at[x].set(sin).at[y].set(-sin) * other

    return _turn(quantity.name, sees)


def _turned_places(places: list[tuple[Quantity, int]]) -> list[Distortion]:
    """Return one turn for each origin: of all places with that origin and the differences that follow them."""
    starts = {quantity.name: start for quantity, start in places}
    groups: dict[tuple[float, float], list[tuple[Quantity, int]]] = {}
    for quantity, start in places:
        if quantity.follows and quantity.follows not in starts:
            raise UserError(f"slice {quantity.name!r} follows {quantity.follows!r}, which is not a slice: name one")
        if (quantity.origin is not None or quantity.follows) and (quantity.unit != "m" or quantity.size < 2):
            what = "follows another" if quantity.follows else "has an origin"
            raise UserError(f"slice {quantity.name!r} {what} but is not a place: give x and y in metres")
        if quantity.origin is not None:
            groups.setdefault(quantity.origin, []).append((quantity, start))
    turns = []
    for origin, slices in groups.items():
        names = {quantity.name for quantity, _ in slices}
        followers = [(start, starts[one.follows]) for one, start in places if one.follows in names]
        turns.append(_turned_about(origin, slices, followers))
    return turns


def _turned_about(
    origin: tuple[float, float], slices: list[tuple[Quantity, int]], followers: list[tuple[int, int]]
) -> Distortion:
    """Return places as they were before a turn about a point.

    `followers`: first entries of differences, each with the first entry of the place that it is displaced with.
    """
    pairs = [(start, start) for _, start in slices] + followers
    entries, by = (jnp.array(column) for column in zip(*pairs, strict=True))

    def sees(theta: Array, obs: Array) -> Array:
        cos, sin = jnp.cos(jnp.deg2rad(theta[0])), jnp.sin(jnp.deg2rad(theta[0]))
        x, y = obs[by] - origin[0], obs[by + 1] - origin[1]
        change_x, change_y = cos * x + sin * y - x, cos * y - sin * x - y
        return obs + jnp.zeros(len(obs)).at[entries].set(change_x).at[entries + 1].set(change_y)

    return _turn(_called(slices), sees)
