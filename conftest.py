"""What the tests of the package and of the plugins share: they record how closely numbers agree with their oracles."""

pytest_plugins = ["shared.oracles"]
