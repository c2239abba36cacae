"""brax's environments for our loop, ours for brax's agents, and training a walker by brax's PPO."""
