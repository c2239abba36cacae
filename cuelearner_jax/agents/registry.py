"""The registry of agents. Add your own with `AGENTS.register`, or name it as package.module:NAME."""

from __future__ import annotations

from cuelearner_jax.agents import ddqn, sac
from cuelearner_jax.agents.protocol import AgentOptions
from cuelearner_jax.plugins import PartRegistry

AGENTS = PartRegistry[AgentOptions]("agent", "make", ddqn.Config, sac.Config)
