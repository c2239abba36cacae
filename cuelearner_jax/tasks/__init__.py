"""The tasks: their registry and those that come with the package. The only place that imports cuelearner_envs."""
