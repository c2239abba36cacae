"""Studies as requests: what is asked for, the rules that fill the rest, and the way from there to a result."""
