"""When the guide's action is executed in place of the agent's: the protocol, whole episodes, paced episodes."""
