"""Run folders, checkpoints, metrics and the loop over phases; nothing here knows a learner."""
