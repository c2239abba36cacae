"""Tasks: the registry, and the tasks of the package. The only package that imports cuelearner_envs."""
