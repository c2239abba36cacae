"""A policy as a file that a robot can use: the whole decision, and a contract that says what goes in and comes out.

`runner` needs nothing but NumPy and lies beside every exported decision; the other modules write what it reads.
"""
