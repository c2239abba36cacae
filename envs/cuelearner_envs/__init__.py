"""The tasks of CueLearner: environments, teachers and drawings. No agent is used here."""
