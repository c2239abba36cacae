"""`python -m cuelearner_jax.cli`: the same as `cuelearner`."""

import sys

from cuelearner_jax.cli import main

sys.exit(main())
