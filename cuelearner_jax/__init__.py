"""CueLearner in JAX: learning from relative feedback combined with off-policy deep RL (arXiv 2507.04730)."""

__version__ = "0.1.0"
