"""Read drawings: colours of pixels, pictures of films."""

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image, ImageSequence


def is_colour(found, name, tolerance=0.02):
    """Return a mask of the pixels (..., 3) with a colour."""
    return np.abs(np.asarray(found) - to_rgb(name)).max(axis=-1) < tolerance


def film(file):
    """Pictures of a GIF and how long each stands [s]."""
    with Image.open(file) as image:
        pictures, durations = [], []
        for frame in ImageSequence.Iterator(image):
            pictures.append(np.asarray(frame.convert("RGB")) / 255)
            durations.append(frame.info["duration"] / 1000)
    return pictures, np.array(durations)
