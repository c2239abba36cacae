"""The cues of Fetch's actions, and of the arm's: words for more and for less of each entry, and names."""

CUES = ("forward,backward", "left,right", "up,down", "open,close")
CUE_NAMES = ("x", "y", "z", "fingers")
