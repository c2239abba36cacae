"""When the guide's action is executed in place of the agent's."""
