"""The parts of the classifier: network step, execution providers, lanes, deadline, early exit."""
