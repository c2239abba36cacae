"""`python -m cuelearner_jax.cli`: runs `cuelearner`."""

import sys

from cuelearner_jax.cli import main

sys.exit(main())
