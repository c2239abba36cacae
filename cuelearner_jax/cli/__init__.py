"""The command `cuelearner`: dispatch, and one file per command with its options."""

from cuelearner_jax.cli.dispatch import main as main
