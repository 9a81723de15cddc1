"""Answers which estimator to take for data like a user's own: `ipe-bench run MODEL FILE`."""
