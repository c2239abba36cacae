"""Gymnasium's environments in our loop: pure functions of a seed and actions, played by instances in processes.

`environment` is what JAX sees. `pool` finds the instance that stands where a state says, or makes one stand there.
`instances` plays them, here or in other processes. `source` makes them.
"""
