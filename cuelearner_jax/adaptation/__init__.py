"""Post-hoc adaptation: labels about a finished policy's actions, a model of them, and the two as one policy."""
