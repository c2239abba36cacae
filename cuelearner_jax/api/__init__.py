"""The public Python API: what `import cuelearner_jax as cl` offers."""
