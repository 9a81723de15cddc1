"""Stores to fill with made-up trials."""

from pathlib import Path

import pytest
from synthetic_store import Synthetic


@pytest.fixture
def synthetic(tmp_path: Path) -> Synthetic:
    """An empty store to fill."""
    return Synthetic(tmp_path / "store")
