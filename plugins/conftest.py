"""Lets tests of plugins record how closely numbers agree with their oracles, as those of the package do."""

from shared import oracles


def pytest_configure(config):
    oracles.join(config)
