"""The long run of the Roomba driver: whatever happens, under every quirk, in any order."""

import random

import pytest

from tests.test_roomba_faults import HAPPENINGS, survive
from tests.test_roomba_quirks import WORKS


@pytest.mark.parametrize("name", [name for name, quirks in WORKS.items() if quirks.brc_wired and quirks.wakes_by_brc])
@pytest.mark.parametrize("seed", range(10))
def test_whatever_happens_the_wheels_turn_by_wish_alone_and_the_end_is_a_halt(name, seed):
    rng = random.Random(f"{name} {seed}")
    happenings = [(rng.choice(HAPPENINGS), rng.uniform(0.02, 3.0)) for _ in range(rng.randint(5, 25))]
    survive(happenings, WORKS[name], seed)
