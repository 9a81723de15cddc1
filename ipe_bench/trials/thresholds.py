"""Where a line is drawn between trials: inside the gate or not, the same root or another, a fit or
a misfit; and how many trials are enough."""

HELD = 0.9
"""Share of all trials that succeed where an estimator does."""
GATE = 1e-6
"""A success lies inside the ellipsoid that all but this share of efficient estimates lie in."""
SAME_ROOT = 1e-3
"""Two roots closer than this, in standard deviations of the Cramér-Rao bound, are one."""
FIT_LEVEL = 1e-3
"""A model fits where residuals as large as these are no less probable than this."""
DETECTED = 0.5
"""Share of trials from which on a misfit counts as detected."""
FEW = 20
"""Below this many trials a figure that is conditional on them has no interval, and no place on a
curve unmarked."""
HISTORIES = 20
"""Trials whose iterates are kept: the first ones of a scenario, in whatever blocks they are
computed."""
EXPECTED = 50
"""Truths over which Van Trees's bound takes the mean of the information."""
EVEN = 0.3
"""A mean is carried by few if their effective number is less than this share of them."""


def gate(n: int) -> float:
    """Computes the squared Mahalanobis error of n parameters up to which a trial is a success."""
    from scipy.special import chdtri

    return float(chdtri(n, GATE))
