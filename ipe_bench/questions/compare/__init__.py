"""Whether a second version, setting or estimator is better or worse than a first, trial by
trial."""
