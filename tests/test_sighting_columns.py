"""Very many sightings at once: columns from records and records from columns, compiled as in plain Python."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import given, strategies as st

from robotd import sighting_columns
from robotd.records import MappedSighting, Sighting

pixel = st.floats(-1e4, 1e4)
sightings = st.lists(
    st.builds(
        Sighting,
        camera=st.sampled_from(["front", "left", "unknown"]),
        label=st.text(max_size=4),
        u=pixel,
        v=pixel,
        sigma_px=st.none() | st.floats(0.01, 9.0),
        probability=st.none() | st.floats(0.0, 1.0),
    ),
    max_size=20,
)
CAMERAS = {"front": 0, "left": 1}


def plainly(function, *arguments):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sighting_columns, "kernel", None)
        return function(*arguments)


@given(rows=sightings)
def test_columns_are_those_of_plain_python(rows):
    camera, label, numbers = sighting_columns.read(rows, CAMERAS, 0.3)
    expected = plainly(sighting_columns.read, rows, CAMERAS, 0.3)
    np.testing.assert_array_equal(camera, expected[0])
    assert label == expected[1]
    np.testing.assert_array_equal(numbers, expected[2])


@given(rows=st.lists(st.builds(MappedSighting, st.integers(), st.integers(), st.text(), st.text(), st.none(), pixel)))
def test_records_from_columns_are_those_that_constructors_make(rows):
    columns = [[getattr(row, name) for row in rows] for name in MappedSighting.__dataclass_fields__]
    made = sighting_columns.made(MappedSighting, columns)
    assert made == tuple(rows) == plainly(sighting_columns.made, MappedSighting, columns)
    for record in made:
        with pytest.raises(FrozenInstanceError):
            record.leg = 2


def test_columns_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="need 6 columns of one length, got \\[1, 2\\]"):
        sighting_columns.made(MappedSighting, [[1], [1, 2]])
