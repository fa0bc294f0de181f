"""Surveys, maps and tables: what is written comes back, and what is wrong is named."""

import json
import os
from dataclasses import replace

import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import InputError
from robotd.files import (
    check_survey,
    header_from_json,
    load_map,
    load_points,
    load_survey,
    map_from_json,
    map_to_json,
    save_map,
    save_map_csv,
    save_survey,
    save_truth,
    stop_from_json,
    stop_to_json,
    survey_from_json,
    survey_to_json,
    write_atomic,
)
from robotd.records import (
    BeaconSighting,
    CameraModel,
    Candidate,
    KnownLabel,
    Map,
    MappedLabel,
    MappedSighting,
    MappedStop,
    Move,
    Pose,
    Priors,
    Rig,
    RoofCamera,
    Sighting,
    Sigmas,
    SolverRun,
    Stop,
    Survey,
    Transform,
)

EXAMPLE = {
    "format": "robotd-survey/1",
    "survey": "room",
    "created": "2026-11-21T10:00:00Z",
    "rig": {
        "cameras": [
            {
                "name": "front",
                "size": [640, 480],
                "model": "brown-conrady",
                "matrix": [268.5, 268.5, 319.5, 239.5],
                "distortion": [-0.06, 0.012, 0.0, 0.0, 0.0],
                "valid_radius_px": None,
                "T_robot_camera": {"rotation": [-1.2092, 1.2092, -1.2092], "translation": [0.06, 0.0, 0.5]},
            }
        ],
        "beacons": {"front": [0.10, 0.0, 0.65], "rear": [-0.10, 0.0, 0.65]},
    },
    "sigmas": {"pixel_px": 0.3, "roof_px": 1.0},
    "priors": {"tilt_rad": 0.005},
    "known_labels": [{"label": "A17", "position": [1.2, 3.4, 0.8], "sigma_m": 0.005}],
    "roof_cameras": [
        {"name": "roof-1", "size": [1280, 720], "H_world_image": [[0.01, 0, -6], [0, 0.01, -3], [0, 0, 1]]}
    ],
    "stops": [
        {
            "leg": 1,
            "stop": 1,
            "time": "2026-11-21T10:01:12.5Z",
            "odometry": {"x": 0.0, "y": 0.0, "heading": 0.0},
            "move": None,
            "sightings": [{"camera": "front", "label": "A17", "u": 311.2, "v": 200.1}],
            "beacon_sightings": [{"roof_camera": "roof-1", "beacon": "front", "u": 640.2, "v": 301.7}],
        },
        {
            "leg": 1,
            "stop": 2,
            "time": "2026-11-21T10:02:00Z",
            "odometry": {"x": 0.7, "y": 0.0, "heading": 0.1},
            "move": {
                "dx": 0.7,
                "dy": 0.0,
                "dheading": 0.1,
                "covariance": [[1e-4, 0, 0], [0, 1e-4, 1e-5], [0, 1e-5, 1e-4]],
            },
            "sightings": [
                {"camera": "front", "label": "A17", "u": 300.0, "v": 190.0, "sigma_px": 0.1, "probability": 0.9}
            ],
        },
    ],
}
MAP = {
    "format": "robotd-map/1",
    "survey": "room",
    "frame": "first stop",
    "labels": [
        {
            "label": "A17",
            "status": "placed",
            "position": [1.201, 3.398, 0.802],
            "covariance": [[1e-6, 0, 0], [0, 4e-6, 0], [0, 0, 9e-6]],
            "sightings": 6,
            "inliers": 6,
            "reason": None,
            "candidates": [],
        },
        {"label": "A18", "status": "unplaced", "sightings": 1, "inliers": 0, "reason": "seen from one stop only"},
    ],
    "stops": [
        {"leg": 1, "stop": 1, "x": 0.0, "y": 0.0, "heading": 0.0, "covariance": [[0, 0, 0], [0, 0, 0], [0, 0, 0]]}
    ],
    "sightings": [{"leg": 1, "stop": 1, "camera": "front", "label": "A17", "residual_px": [0.1, -0.2], "weight": 1.0}],
    "cost": 71.3,
    "rms_px": 0.31,
    "solver": {"iterations": 6, "converged": True, "method": "bundle"},
    "notes": [],
}


def changed(table, path, value):
    """A copy of a file's content with the value at a path (keys and indices) replaced; DELETE removes it."""
    copy = json.loads(json.dumps(table))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    if value is DELETE:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return copy


DELETE = object()


def read(table):
    return survey_from_json(json.dumps(table).encode(), "room.json")


def problems_of(table, reader=survey_from_json):
    with pytest.raises(InputError) as caught:
        reader(json.dumps(table).encode(), "room.json")
    return caught.value.problems


def test_the_documented_example_is_read():
    survey = read(EXAMPLE)
    assert survey.rig.cameras[0].T_robot_camera.translation == (0.06, 0.0, 0.5)
    assert survey.stops[0].move is None
    assert survey.stops[1].move.covariance[1][2] == 1e-5
    assert survey.priors == Priors(tilt_rad=0.005)
    assert survey.known_labels == (KnownLabel("A17", (1.2, 3.4, 0.8), 0.005),)
    assert survey.stops[0].beacon_sightings[0].roof_camera == "roof-1"


def test_a_missing_optional_key_means_null_and_null_means_missing():
    table = changed(EXAMPLE, ["priors"], None)
    table["sigmas"] = table["created"] = table["stops"][1]["beacon_sightings"] = None
    del table["stops"][0]["move"]
    survey = read(table)
    assert survey.priors == Priors()
    assert survey.sigmas == Sigmas()
    assert survey.stops[0].move is None


MISTAKES = [
    (["format"], "robotd-survey/2", ["format: found", "expected", "robotd-survey/1"]),
    (["format"], DELETE, ["missing key 'format'", "robotd-survey/1"]),
    (["survey"], DELETE, ["missing key 'survey'"]),
    (["survay"], "x", ["unknown key 'survay'", "did you mean 'survey'"]),
    (["created"], "yesterday", ["created: found 'yesterday'", "date"]),
    (["sigmas", "pixel_px"], 0, ["sigmas.pixel_px: found 0", "above 0"]),
    (["priors", "tilt_rad"], -1, ["priors.tilt_rad: found -1"]),
    (["rig", "cameras"], [], ["rig.cameras: found none"]),
    (["rig", "cameras"], EXAMPLE["rig"]["cameras"] * 2, ["rig.cameras: name 'front' is given 2 times"]),
    (["rig", "cameras", 0, "size"], [640, 0], ["rig.cameras[0].size: found [640, 0]"]),
    (["rig", "cameras", 0, "matrix", 1], -268.5, ["rig.cameras[0].matrix[1]: found -268.5"]),
    (["rig", "cameras", 0, "distortion"], [0.0] * 6, ["cameras[0].distortion: found 6", "4, 5 or 8 for brown-conrady"]),
    (["rig", "cameras", 0, "model"], "fisheye", ["cameras[0].distortion: found 5", "expected 4 for fisheye"]),
    (["rig", "cameras", 0, "model"], "pinhole", ["cameras[0].model: found 'pinhole'", "'brown-conrady', 'fisheye'"]),
    (["rig", "cameras", 0, "valid_radius_px"], 0, ["valid_radius_px: found 0"]),
    (["known_labels", 0, "sigma_m"], 0, ["known_labels[0].sigma_m: found 0"]),
    (["known_labels"], EXAMPLE["known_labels"] * 2, ["known_labels: label 'A17' is given 2 times"]),
    (["roof_cameras", 0, "H_world_image", 2], [0, 0, 0], ["roof_cameras[0].H_world_image: is singular"]),
    (["roof_cameras", 0, "covariance"], [[1.0]], ["roof_cameras[0].covariance: expected 9 rows of 9"]),
    (["roof_cameras", 0, "covariance"], [[-1.0] * 9] * 9, ["roof_cameras[0].covariance: is not positive semi"]),
    (["stops", 0, "move"], EXAMPLE["stops"][1]["move"], ["stops[0].move: is the first stop of leg 1; expected null"]),
    (["stops", 1, "move"], None, ["stops[1].move: found null"]),
    (["stops", 1, "stop"], 1, ["stops[1].stop: leg 1 has stop 1 twice"]),
    (["stops", 1, "stop"], 0, ["stops[1].stop: found 0; expected a number from 1"]),
    (["stops", 1, "leg"], 2, ["stops[1].move: is the first stop of leg 2"]),
    (["stops", 1, "time"], "", ["stops[1].time: found ''"]),
    (["stops", 1, "odometry", "x"], "0", ["stops[1].odometry.x: found '0'; expected a number"]),
    (["stops", 1, "move", "covariance", 0, 1], 1e-4, ["stops[1].move.covariance: is not symmetric"]),
    (["stops", 1, "move", "covariance", 0, 0], -1e-4, ["stops[1].move.covariance: has the negative eigenvalue"]),
    (["stops", 1, "move", "covariance"], [[1, 0], [0, 1]], ["stops[1].move.covariance: found a list of 2; expected 3"]),
    (
        ["stops", 1, "sightings", 0, "camera"],
        "frond",
        ["stops[1].sightings[0].camera: 'frond'", "did you mean 'front'"],
    ),
    (["stops", 1, "sightings", 0, "u"], 6400.0, ["stops[1].sightings[0].u: found 6400", "640 px wide"]),
    (["stops", 1, "sightings", 0, "v"], -300, ["stops[1].sightings[0].v: found -300", "480 px high"]),
    (["stops", 1, "sightings", 0, "sigma_px"], 0.0, ["stops[1].sightings[0].sigma_px: found 0"]),
    (
        ["stops", 1, "sightings", 0, "probability"],
        1.5,
        ["stops[1].sightings[0].probability: found 1.5; expected 0 to 1"],
    ),
    (["stops", 1, "sightings", 0, "label"], "", ["stops[1].sightings[0].label: found an empty text"]),
    (["stops", 1, "sightings", 0, "u"], 10**400, ["stops[1].sightings[0].u", "finite"]),
    (["stops", 1, "stop"], 10**400, ["stops[1].stop"]),
    (["stops", 0, "beacon_sightings", 0, "beacon"], "fornt", ["beacon_sightings[0].beacon: 'fornt'", "mean 'front'"]),
    (["stops", 0, "beacon_sightings", 0, "roof_camera"], "x", ["roof_camera: 'x' is no roof camera", "roof-1"]),
    (["stops", 0, "beacon_sightings", 0, "sigma_px"], -1, ["stops[0].beacon_sightings[0].sigma_px: found -1"]),
]


@pytest.mark.parametrize(("path", "value", "parts"), MISTAKES, ids=[parts[0] for _, _, parts in MISTAKES])
def test_a_mistake_is_named_with_its_path(path, value, parts):
    problems = problems_of(changed(EXAMPLE, path, value))
    assert any(all(part in problem for part in parts) for problem in problems), problems
    assert all(problem.startswith("room.json") for problem in problems)


def test_all_mistakes_are_named_at_once_even_when_some_are_of_type_and_some_of_sense():
    table = changed(EXAMPLE, ["stops", 1, "odometry", "x"], "zero")
    table["rig"]["cameras"][0]["size"] = [0, 0]
    table["stops"][0]["sightings"][0]["camera"] = "frond"
    table["known_labels"][0]["sigma_m"] = -1
    table["extra"] = 1
    text = "\n".join(problems_of(table))
    for part in ("odometry.x", "cameras[0].size", "sightings[0].camera", "known_labels[0].sigma_m", "'extra'"):
        assert part in text


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"", "line 1, column 1 (byte 0)"),
        (b'{"a": 1,\n "b" 2}', "line 2, column 6 (byte 14)"),
        (b'{"a": NaN}', "found NaN; expected a finite number"),
        (b'{"a": -Infinity}', "found -Infinity"),
        (b'{"a": 1e999}', "found 1e999"),
        (b'{"a":\n "\xff"}', "line 2, column 3 (byte 8): not UTF-8"),
        (b"[1, 2]", "expected an object in braces"),
        (b"[" * 100_000, "nested too deeply"),
        (b'{"format": "robotd-survey/1", "a": 1, "a": 2}', "key 'a' is given more than once"),
        (b'{"format": "robotd-map/1"}', 'found "robotd-map/1"; expected "robotd-survey/1"'),
        (b'{"format": 1}', 'found 1; expected "robotd-survey/1"'),
    ],
)
def test_what_is_not_a_survey_at_all_is_refused_with_the_place(data, part):
    with pytest.raises(InputError, match=r"^room\.json") as caught:
        survey_from_json(data, "room.json")
    assert part in str(caught.value)


def test_numbers_that_are_not_finite_are_named_by_stop_and_field_with_all_other_mistakes():
    table = changed(EXAMPLE, ["stops", 0, "sightings", 0, "u"], float("nan"))
    table["stops"][1]["move"]["covariance"][2][2] = float("inf")
    table["rig"]["cameras"][0]["size"] = [0, 0]
    text = "\n".join(problems_of(table))
    assert "stops[0].sightings[0].u: found nan; expected a finite number" in text
    assert "stops[1].move.covariance[2][2]: found inf" in text
    assert "cameras[0].size" in text


# ---- round trips -----------------------------------------------------------------------------------------------------

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
small = st.floats(-1e3, 1e3)
positive = st.floats(1e-6, 1e6)
names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8)
vectors = st.tuples(finite, finite, finite)
covariances = st.tuples(st.floats(0, 1e3), st.floats(0, 1e3), st.floats(0, 1e3)).map(
    lambda d: ((d[0], 0.0, 0.0), (0.0, d[1], 0.0), (0.0, 0.0, d[2]))
)


@st.composite
def surveys(draw):
    size = (640, 480)
    cameras = tuple(
        CameraModel(
            name,
            size,
            draw(st.tuples(positive, positive, small, small)),
            Transform(draw(vectors), draw(vectors)),
            distortion=draw(st.sampled_from([(0.0,) * 5, (0.1,) * 4, (1e-3,) * 8])),
            valid_radius_px=draw(st.none() | positive),
        )
        for name in draw(st.lists(names, unique=True, min_size=1, max_size=3))
    )
    beacons = draw(st.dictionaries(names, vectors, max_size=2))
    roofs = tuple(
        RoofCamera(name, size, ((0.01, 0.0, draw(small)), (0.0, 0.02, 0.0), (0.0, 0.0, 1.0)))
        for name in draw(st.lists(names, unique=True, max_size=2))
    )
    stops = []
    for leg in range(1, draw(st.integers(0, 3)) + 1):
        for number in range(1, draw(st.integers(1, 3)) + 1):
            sightings = draw(
                st.lists(
                    st.builds(
                        Sighting,
                        st.sampled_from([camera.name for camera in cameras]),
                        names,
                        st.floats(0, 639),
                        st.floats(0, 479),
                        st.none() | positive,
                        st.none() | st.floats(0, 1),
                    ),
                    max_size=3,
                )
            )
            seen = []
            if beacons and roofs:
                beacon, roof = draw(st.sampled_from(sorted(beacons))), draw(st.sampled_from(roofs)).name
                seen = [BeaconSighting(roof, beacon, draw(st.floats(0, 639)), draw(st.floats(0, 479)))]
            move = None if number == 1 else Move(draw(small), draw(small), draw(small), draw(covariances))
            pose = Pose(draw(finite), draw(finite), draw(finite))
            stops.append(Stop(leg, number, "2026-11-21T10:02:00Z", pose, move, tuple(sightings), tuple(seen)))
    known = tuple(
        KnownLabel(name, draw(vectors), draw(positive)) for name in draw(st.lists(names, unique=True, max_size=2))
    )
    return Survey(
        draw(names), Rig(cameras, beacons), tuple(stops), None, Sigmas(draw(positive)), Priors(0.1), known, roofs
    )


@settings(deadline=None, max_examples=25)
@given(surveys())
def test_a_survey_comes_back_exactly(survey):
    assert survey_from_json(survey_to_json(survey), "x") == survey
    check_survey(survey, "x")


@settings(deadline=None, max_examples=15)
@given(surveys())
def test_a_survey_sent_as_header_and_stops_comes_back_exactly(survey):
    header = header_from_json(survey_to_json(replace(survey, stops=())), "x")
    stops = tuple(stop_from_json(stop_to_json(stop), "x", header) for stop in survey.stops)
    assert replace(header, stops=stops) == survey


@st.composite
def maps(draw):
    labels = tuple(
        MappedLabel(name, "placed", draw(vectors), draw(covariances), 3, 2)
        if draw(st.booleans())
        else MappedLabel(name, "ambiguous", None, None, 2, 0, draw(names), (Candidate(draw(vectors), 1.5),))
        for name in draw(st.lists(names, unique=True, max_size=4))
    )
    stops = tuple(MappedStop(1, n, draw(finite), draw(finite), draw(finite), draw(covariances)) for n in range(1, 4))
    sightings = (
        MappedSighting(1, 1, "front", "A", draw(st.none() | st.tuples(finite, finite)), draw(st.floats(0, 1))),
    )
    run = SolverRun(3, draw(st.booleans()), "linear")
    return Map("s", draw(names), labels, stops, sightings, draw(st.floats(0, 1e9)), 0.5, run, (draw(names),))


@settings(deadline=None, max_examples=25)
@given(maps())
def test_a_map_comes_back_exactly(result):
    assert map_from_json(map_to_json(result), "x") == result


def test_files_come_back_exactly(tmp_path):
    survey, result = read(EXAMPLE), map_from_json(json.dumps(MAP).encode(), "m")
    save_survey(survey, tmp_path / "survey.json")
    save_map(result, tmp_path / "map.json")
    assert load_survey(tmp_path / "survey.json") == survey
    assert load_map(tmp_path / "map.json") == result
    assert sorted(os.listdir(tmp_path)) == ["map.json", "survey.json"]


@pytest.mark.parametrize(
    ("path", "value", "part"),
    [
        (["labels", 1, "label"], "A17", "labels: label 'A17' is given 2 times"),
        (["labels", 0, "position"], None, "labels[0].position: found null for a label that is placed"),
        (["labels", 1, "position"], [0, 0, 0], "labels[1].position: found a position for a label that is unplaced"),
        (["labels", 0, "covariance", 0, 0], -1.0, "labels[0].covariance: has the negative eigenvalue"),
        (["labels", 0, "inliers"], -1, "labels[0].inliers: found -1"),
        (["stops"], MAP["stops"] * 2, "stops[1]: leg 1 stop 1 is given more than once"),
        (["sightings", 0, "weight"], 2, "sightings[0].weight: found 2"),
        (["rms_px"], -1, "rms_px: found -1"),
        (["solver", "method"], "magic", "solver.method: found 'magic'; expected one of 'bundle', 'linear'"),
        (["format"], "robotd-survey/1", 'expected "robotd-map/1"'),
    ],
)
def test_a_mistake_in_a_map_is_named_with_its_path(path, value, part):
    assert any(part in problem for problem in problems_of(changed(MAP, path, value), map_from_json))


def test_a_header_with_stops_in_it_is_refused():
    with pytest.raises(InputError, match="stops: expected an empty list"):
        header_from_json(json.dumps(EXAMPLE).encode(), "PUT /api/surveys/room")


def test_a_stop_is_checked_against_its_header():
    header = header_from_json(json.dumps(changed(EXAMPLE, ["stops"], DELETE)).encode(), "x")
    stop = changed(EXAMPLE["stops"][1], ["sightings", 0, "camera"], "left")
    with pytest.raises(InputError, match=r"^leg 1/stop 2 sightings\[0\]\.camera: 'left' is no camera"):
        stop_from_json(json.dumps(stop).encode(), "leg 1/stop 2", header)
    assert stop_from_json(json.dumps(stop).encode(), "x").sightings[0].camera == "left"


def test_numbers_that_are_not_finite_are_never_written():
    survey = read(EXAMPLE)
    broken = replace(survey, known_labels=(KnownLabel("A", (0.0, float("nan"), 0.0)),))
    with pytest.raises(InputError, match=r"known_labels\[0\]\.position\[1\] is nan"):
        survey_to_json(broken)


# ---- fuzz ------------------------------------------------------------------------------------------------------------


def read_or_refused(data):
    try:
        return survey_from_json(data, "room.json"), ()
    except InputError as error:
        return None, error.problems


VALID = json.dumps(EXAMPLE).encode()
junk = st.sampled_from(
    [
        *(None, True, False, -1, 0, 1, 2**63, -(2**70), 10**400, 1e308, -1e308, 5e-324, "", "front", "A17", [], {}),
        *([[[]]], {"a": 1}, [1, 2, 3], [[1e308] * 3] * 3, "\u0000", "2026", [None], "robotd-map/1"),
    ]
)


@st.composite
def mutated_tables(draw):
    table = json.loads(VALID)
    for _ in range(draw(st.integers(1, 3))):
        places = []

        def walk(value, places):
            for key, item in value.items() if isinstance(value, dict) else enumerate(value):
                places.append((value, key))
                if isinstance(item, dict | list):
                    walk(item, places)

        walk(table, places)
        holder, key = draw(st.sampled_from(places))
        action = draw(st.sampled_from(["replace", "delete", "rename", "double"]))
        if action == "delete":
            del holder[key]
        elif action == "rename" and isinstance(holder, dict):
            holder[draw(st.text(max_size=4))] = holder.pop(key)
        elif action == "double" and isinstance(holder, list):
            holder.append(holder[key])
        else:
            holder[key] = draw(junk)
    return table


@settings(deadline=None, max_examples=80)
@given(mutated_tables())
def test_a_survey_with_random_values_is_read_or_refused_with_reasons(table):
    survey, reasons = read_or_refused(json.dumps(table).encode())
    if survey is None:
        assert reasons
        assert all(reason.startswith("room.json") for reason in reasons)
    else:
        assert survey_from_json(survey_to_json(survey), "x") == survey


@settings(deadline=None, max_examples=80)
@given(st.lists(st.tuples(st.integers(0, len(VALID) - 1), st.integers(0, 255)), max_size=4), st.integers(0, len(VALID)))
def test_a_survey_with_random_bytes_is_read_or_refused_with_reasons(changes, end):
    data = bytearray(VALID)
    for position, byte in changes:
        data[position] = byte
    for piece in (bytes(data), bytes(data[:end])):
        survey, reasons = read_or_refused(piece)
        assert survey is not None or reasons


# ---- tables ----------------------------------------------------------------------------------------------------------


def test_truth_comes_back_exactly(tmp_path):
    positions = {'A "1", <b>': (0.1, -2.0, 1 / 3), "å": (1e-9, 0.0, 5.0)}
    save_truth(tmp_path / "truth.csv", positions)
    assert (tmp_path / "truth.csv").read_text().startswith("label,x,y,z\n")
    assert load_points(tmp_path / "truth.csv") == {label: (xyz, None) for label, xyz in positions.items()}


def test_known_labels_may_have_a_sigma_each(tmp_path):
    (tmp_path / "known.csv").write_bytes(b"\xef\xbb\xbflabel, x, y, z, sigma\r\nA, 1, 2, 3, 0.01\r\n\r\nB,1,2,3,\r\n")
    points = load_points(tmp_path / "known.csv")
    assert points == {"A": ((1.0, 2.0, 3.0), 0.01), "B": ((1.0, 2.0, 3.0), None)}


def test_all_mistakes_of_a_table_are_named_with_their_lines(tmp_path):
    path = tmp_path / "known.csv"
    path.write_text("label,x,y,z,sigma\nA,1,2,inf,0\nA,1,zwei,3,0.1\nB,1,2\n,1,2,3,1\n")
    with pytest.raises(InputError) as caught:
        load_points(path)
    expected = [
        "2 z: found 'inf'",
        "2 sigma: found 0",
        "3 label: 'A'",
        "3 y: found 'zwei'",
        "4: found 3 cells",
        "5 label",
    ]
    assert len(caught.value.problems) == len(expected)
    for part in expected:
        assert any(f"line {part}" in problem for problem in caught.value.problems), part


@pytest.mark.parametrize(
    "data", [b"", b"label;x;y;z\nA;1;2;3\n", b"label,x,y\n", b"\xff\xfe", b'label,x,y,z\n"A,1,2,3\n']
)
def test_what_is_not_a_table_at_all_is_refused(tmp_path, data):
    (tmp_path / "t.csv").write_bytes(data)
    with pytest.raises(InputError, match=r"t\.csv"):
        load_points(tmp_path / "t.csv")


def test_a_map_as_a_table_leaves_unknown_cells_empty(tmp_path):
    save_map_csv(map_from_json(json.dumps(MAP).encode(), "m"), tmp_path / "map.csv")
    assert (tmp_path / "map.csv").read_text().splitlines() == [
        "label,x,y,z,sx,sy,sz,status,sightings",
        "A17,1.201,3.398,0.802,0.001,0.002,0.003,placed,6",
        "A18,,,,,,,unplaced,1",
    ]


# ---- the disk --------------------------------------------------------------------------------------------------------


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "survey.json"
    path.write_text("old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        write_atomic(path, b"new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["survey.json"]


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path):
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    write_atomic(tmp_path / "link.json", b"new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_text() == "new"
    write_atomic("/dev/null", b"new")


def test_files_that_cannot_be_read_or_written_say_why(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_survey(tmp_path / "none.json")
    with pytest.raises(InputError, match="Is a directory"):
        load_survey(tmp_path)
    with pytest.raises(InputError, match="No such file or directory"):
        save_survey(read(EXAMPLE), tmp_path / "none" / "survey.json")
