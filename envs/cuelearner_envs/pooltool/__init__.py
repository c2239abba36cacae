"""Billiards on pooltool's physics: cloth that balls slide and roll on, spin, cushions; a world that others wrote."""
