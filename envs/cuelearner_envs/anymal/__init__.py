"""A quadruped like ANYmal C in MuJoCo: model, walking policy, and the navigation task on it."""
