"""Real readings: from a file to an answer."""
