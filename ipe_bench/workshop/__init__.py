"""Serves authors of plugins: templates to start from, conformance tests, pages for coding agents, a
guard in CI."""
