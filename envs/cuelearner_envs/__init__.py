"""The tasks of CueLearner: environments, teachers and drawings. They know no agent."""
