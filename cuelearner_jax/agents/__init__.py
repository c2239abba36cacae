"""The agent: networks of action values, double DQN, replay, the greedy choice."""
