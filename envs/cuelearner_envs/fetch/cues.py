"""The cues of Fetch's and the arm's actions: names, and words for more and less of each entry."""

CUES = ("forward,backward", "left,right", "up,down", "open,close")
CUE_NAMES = ("x", "y", "z", "fingers")
