"""Read drawings: colours of pixels, pictures of films."""

import numpy as np
from matplotlib.colors import to_rgb


def is_colour(found, name, tolerance=0.02):
    """Return a mask of the pixels (..., 3) with a colour."""
    return np.abs(np.asarray(found) - to_rgb(name)).max(axis=-1) < tolerance
