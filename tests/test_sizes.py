"""No room outgrows its limit without a line that says what users get for it."""

from __future__ import annotations

import pytest
from sizes import content, limits, room_files

ROOMS = room_files()


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_keeps_its_limit(room: str):
    allowed = limits()
    assert room in allowed, f"name {room} and its limit in tests/room_limits.tsv"
    size = sum(map(content, ROOMS[room]))
    assert size <= allowed[room], (
        f"{room} has {size:,} nodes of at most {allowed[room]:,}: what goes for them, or what do "
        "users get? Raise the limit in tests/room_limits.tsv and say it there"
    )


def test_each_limit_is_of_a_room():
    assert set(limits()) == set(ROOMS)
