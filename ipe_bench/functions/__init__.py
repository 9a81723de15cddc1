"""A user's function and its slopes: how they are found, and whether they are believed."""
