"""The face for Python: what `import cuelearner_jax as cl` offers. Small on purpose; the rooms behind it offer more."""
