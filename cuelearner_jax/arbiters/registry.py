"""The registry of arbiters. Add your own with `ARBITERS.register`, or name it as package.module:NAME."""

from __future__ import annotations

from cuelearner_jax.arbiters import by_value, episodes, paced, prior
from cuelearner_jax.arbiters.protocol import ArbiterOptions
from cuelearner_jax.plugins import PartRegistry

ARBITERS = PartRegistry[ArbiterOptions]("arbiter", episodes.Config, paced.Config, prior.Config, by_value.Config)
