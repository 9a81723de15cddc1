"""Which readings to take: bounds, errors that the model leaves out, and choices of readings."""
