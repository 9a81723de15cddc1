"""Where a line is drawn between trials: inside the gate or not, the same root or another, a fit or a misfit."""

GATE = 1e-6
"""A success lies inside the ellipsoid that all but this share of efficient estimates lie in."""
SAME_ROOT = 1e-3
"""Two roots closer than this, in standard deviations of the Cramér-Rao bound, are one."""
FIT_LEVEL = 1e-3
"""A model fits where residuals as large as these are no less probable than this."""
