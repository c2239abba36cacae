"""Agents: the protocol, double DQN, replay, networks."""
