"""A second simulated world, for evaluation only: other contact, friction, gel and marker field.

It shares with the bench what a trial is (objects, nuisances, sensor errors, form of the signals),
and nothing of how a press is solved. No model is trained here and no strategy is tuned here.
"""
