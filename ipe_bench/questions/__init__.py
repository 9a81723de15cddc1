"""Answers questions about a scenario, stored results or a table: one folder each, with its
mathematics, answer, figure and command."""
