"""Calibrations over the control socket: what the person is asked, and the files that come of it."""

import asyncio
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from robotd.clock import now
from robotd.config import Calibration
from robotd.errors import DriverFault
from robotd.recording import read_frames
from robotd.records import CameraModel, Frame, Transform
from robotd.solver_main import main as solver
from robotd.v4l2 import MORE_ROOM, NO_ROOM
from tests.operated import QUICK, operated


async def converse(client, answers=lambda prompt: None, **params):
    """Calibrate, answering every prompt at once; returns the result and the prompts."""
    number = client.send("calibrate", **params)
    prompts = []
    while True:
        message = await client.read()
        if message.get("id") == number:
            return message.get("result", message.get("error")), prompts
        if message.get("method") == "prompt":
            prompts.append(message["params"])
            if prompts[-1]["kind"] != "tell":
                client.send("answer", value=answers(prompts[-1]))


def chessboard():
    squares = np.kron((np.indices((7, 10)).sum(axis=0) % 2).astype(np.uint8), np.ones((24, 24), np.uint8))
    return cv2.copyMakeBorder(255 * squares, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)


def test_pictures_of_a_chessboard_are_kept_with_what_is_known_about_them(tmp_path):
    async def scenario(robot, client):
        publish = robot.course.bus.frames("eye").publish
        robot.course.bus.frames("eye").publish = lambda frame: publish(
            Frame("eye", frame.t, chessboard(), frame.sequence)
        )
        result, prompts = await converse(client, what="floor", pictures=3)
        assert "robotd-solver calibrate floor" in result["text"]
        assert "3 pictures of the board" in result["text"]
        assert [prompt["kind"] for prompt in prompts] == ["ready"] * 3
        data = json.loads((tmp_path / "state" / "calibration" / "floor-20260302T000000Z" / "data.json").read_text())
        assert data["format"] == "robotd-calibration-data/1"
        assert data["board"] == {"columns": 9, "rows": 6, "square_m": 0.025}
        assert [picture["board_found"] for picture in data["pictures"]] == [True] * 3
        assert data["pictures"][0]["odometry"] == {"x": 0.0, "y": 0.0, "heading": 0.0}
        image = cv2.imread(f"{result['folder']}/{data['pictures'][2]['file']}", cv2.IMREAD_GRAYSCALE)
        assert np.array_equal(image, chessboard())

    operated(tmp_path, scenario)


def test_a_picture_without_the_board_is_asked_for_again(tmp_path):
    async def scenario(robot, client):
        assert "there is no camera 'nose'" in (await converse(client, what="camera", camera="nose"))[0]["message"]
        result, prompts = await converse(client, what="camera", camera="eye", pictures=1)
        assert "no picture shows a whole board of 9x6 inner corners" in result["message"]
        assert sum(prompt["kind"] == "ready" for prompt in prompts) == 5
        assert "no cameras of the rig" in (await converse(client, what="rig"))[0]["message"]

    operated(tmp_path, scenario)


def test_a_camera_that_gives_no_picture_fails_the_calibration_and_not_robotd(tmp_path):
    async def scenario(robot, client):
        robot.course.bus.frames("eye").publish = lambda frame: None
        error, _ = await converse(client, what="camera", camera="eye", pictures=1)
        assert "eye: no frame for 5 s; check the camera" in error["message"]
        assert (await client.call("status"))["drivers"]

    operated(tmp_path, scenario)


def test_the_rig_gets_a_survey_of_ways_out_and_back_at_places_driven_or_carried_to(tmp_path):
    level = Transform((-np.pi / 2, 0.0, 0.0), (0.06, 0.0, 0.5))
    calibration = Calibration(cameras=(CameraModel("eye", (64, 48), (30.0, 30.0, 31.5, 23.5), level),))

    async def scenario(robot, client):
        robot.daemon.assembly.cameras["eye"] = robot.eye
        metres = iter([0.3, 0.0])

        def answers(prompt):
            return next(metres) if prompt["kind"] == "measure" else None

        result, prompts = await converse(client, answers, what="rig", places=3)
        name = result["survey"]
        assert name == "rig-20260302T000000Z"
        assert f"robotd-solver calibrate rig {name}.json" in result["text"]
        assert [prompt["kind"] for prompt in prompts if prompt["kind"] != "tell"] == [
            "ready",
            "measure",
            "measure",
            "ready",
        ]
        made = await client.call("survey.export", survey=name)
        assert [(stop["leg"], stop["stop"]) for stop in made["stops"]] == [
            *((1, k) for k in range(1, 9)),
            *((2, k) for k in range(9, 13)),
        ]
        ahead, turned, back, on = (made["stops"][k]["move"] for k in (1, 2, 3, 4))
        for straight in (ahead, back):
            assert straight["dx"] == pytest.approx(0.25, abs=0.03)
            assert straight["dheading"] == pytest.approx(0.0, abs=0.03)
        assert turned["dx"] == pytest.approx(0.0, abs=0.01)
        assert abs(turned["dheading"]) == pytest.approx(np.pi, abs=0.15)
        assert on["dx"] == pytest.approx(-0.3, abs=0.05), "at the end it looks ahead again, and drives on"
        assert on["dheading"] == pytest.approx(-0.5 * np.pi, abs=0.3), "across, at every second place"
        assert made["stops"][8]["move"] is None
        assert robot.labels.asked

    operated(tmp_path, scenario, calibration=calibration, identify=replace(QUICK, max_slots=1))


def test_the_time_offset_gets_frames_and_odometry_of_a_robot_that_swings(tmp_path):
    async def scenario(robot, client):
        result, _ = await converse(client, what="time", seconds=6.0)
        data = result["data"]
        rows = np.array(data["odometry"]["rows"])
        assert data["odometry"]["columns"] == ["t", "heading", "turn_rate"]
        assert len(rows) > 60 * 6
        assert rows[:, 1].min() < -0.2
        assert rows[:, 1].max() > 0.2
        times = [frame.t for frame in read_frames(tmp_path / "recordings" / f"{data['recording']['name']}.mcap")]
        assert len(times) > 40
        assert rows[0, 0] - 0.5 < times[0] < times[-1] < rows[-1, 0] + 0.5
        await asyncio.sleep(1.0)
        assert not robot.course.is_moving

    operated(tmp_path, scenario)


def test_a_flash_is_recorded_from_before_the_label_was_asked(tmp_path):
    async def scenario(robot, client):
        assert "label: missing" in (await converse(client, what="flash", camera="eye"))[0]["message"]
        result, _ = await converse(client, what="flash", camera="eye", label="A1", seconds=2.0)
        assert robot.labels.asked == ((("A1",), (2,)),)
        assert "no pattern was found" in result["text"]
        times = [
            frame.t for frame in read_frames(tmp_path / "recordings" / f"{result['data']['recording']['name']}.mcap")
        ]
        assert times[0] < result["data"]["asked_t"] < times[-1] - 2.0

    operated(tmp_path, scenario)


def test_the_pattern_of_a_flashing_label_is_learnt_although_nobody_knows_when_it_began(tmp_path, capsys):
    async def scenario(robot, client):
        begun = now() + 2.8
        publish, rng = robot.eye._publish, np.random.default_rng(2)

        def flashing(frame, mode):
            image = (60 + 2 * rng.standard_normal(frame.image.shape)).astype(np.uint8)
            phase = (frame.t - begun) % 1.0
            if begun <= frame.t < begun + 10.0 and any(on <= phase < on + 0.15 for on in (0.0, 0.3)):
                image[20:26, 30:36] = 200
            publish(Frame("eye", frame.t, image, frame.sequence), mode)

        robot.eye._publish = flashing
        result, _ = await converse(client, what="flash", camera="eye", label="A1", seconds=10.0)
        pattern = result["data"]["pattern"]
        assert pattern["period"] == pytest.approx(1.0, abs=0.01)
        assert np.array(pattern["on"]) == pytest.approx(np.array([[0.0, 0.15], [0.3, 0.45]]), abs=0.034)  # one frame
        assert "[mission.identify] pattern = { period = " in result["text"]
        folders.append(result["folder"])

    folders = []
    operated(tmp_path, scenario)
    drawn = tmp_path / "flash.png"
    assert solver(["calibrate", "flash", folders[0], "--picture", str(drawn)]) == 0
    out = capsys.readouterr()
    assert "[mission.identify] pattern = { period = " in out.out
    assert "edges +-" in out.err
    assert drawn.read_bytes()[:4] == b"\x89PNG"
    assert solver(["calibrate", "flash", str(tmp_path)]) == 2
    assert "data.json" in capsys.readouterr().err


@pytest.mark.parametrize("moment", ["asked", "driving"])
def test_a_person_who_hangs_up_ends_the_calibration_and_the_robot_stands(tmp_path, moment):
    async def scenario(robot, client):
        async with robot.connected() as other:
            other.send("calibrate", what="odometry")
            assert (await other.read())["params"]["kind"] == "ready"
            if moment == "driving":
                other.send("answer")
                async with asyncio.timeout(20.0):
                    while not robot.course.is_moving:
                        await asyncio.sleep(0.05)
            assert "calibration of odometry is under way" in (await client.call("mission.start"))["message"]
        end = now() + 1.0
        await asyncio.sleep(end - now())
        assert not robot.course.is_moving
        assert (await client.call("status"))["busy"] is None

    operated(tmp_path, scenario)


def test_everything_together_finds_a_camera_that_loses_frames(tmp_path):
    async def scenario(robot, client):
        well = {item["what"]: item for item in (await client.call("test", seconds=10.0))["findings"]}
        assert well["camera eye, all together"]["level"] == "ok"
        assert well["serial line, all together"]["level"] == "ok"
        publish = robot.eye._publish
        robot.eye._publish = lambda frame, mode: publish(frame, mode) if frame.sequence % 3 == 0 else None
        ill = {item["what"]: item for item in (await client.call("test", seconds=10.0))["findings"]}
        assert ill["camera eye, all together"]["level"] == "warning"
        assert "fps" in ill["camera eye, all together"]["mend"]

        async def refuse(mode):
            raise DriverFault(f"/dev/video0 cannot stream: {NO_ROOM}; {MORE_ROOM}")

        robot.eye._stream = refuse
        full = {item["what"]: item for item in (await client.call("test", seconds=10.0))["findings"]}
        assert full["camera eye"]["text"].endswith("cannot stream: its USB bus has no room")
        assert full["camera eye"]["mend"] == MORE_ROOM
        robot.course.wire.is_cut = True
        async with asyncio.timeout(60.0):
            cut = {item["what"]: item for item in (await client.call("test", seconds=10.0))["findings"]}
        assert cut["serial line, all together"]["level"] == "error"

    operated(tmp_path, scenario)
