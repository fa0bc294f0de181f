"""Operators at the control socket: what is understood, what is refused, and that a lost one halts the robot."""

import asyncio
import dataclasses
import json
import os
import socket
import stat

import msgspec
import numpy as np
import pytest
from hypothesis import given, strategies as st

from robotd import rpc
from robotd.clock import now, run_virtual
from robotd.control_socket import CLIENTS, ControlSocket
from robotd.errors import InputError
from robotd.operations import METHODS
from robotd.rpc import RpcError
from tests.hazard_course import BRAKING
from tests.operated import operated

# ---- the words -------------------------------------------------------------------------------------------------------


def test_a_request_is_read_as_json_rpc_says():
    request = rpc.parse(b'{"jsonrpc": "2.0", "id": 7, "method": "drive", "params": {"speed": 0.1}}\n')
    assert (request.method, request.params, request.id) == ("drive", {"speed": 0.1}, 7)
    assert rpc.parse(b'{"jsonrpc": "2.0", "method": "halt"}').id is None


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        (b"halt", rpc.PARSE_ERROR, "not JSON"),
        (b'{"jsonrpc": "2.0", "method": "drive", "params": {"t": NaN}}', rpc.PARSE_ERROR, "not JSON"),
        (b'{"a": "\xff"}', rpc.PARSE_ERROR, "not JSON"),
        (b"[" * 5000, rpc.PARSE_ERROR, "not JSON"),
        (b'[{"jsonrpc": "2.0", "method": "halt"}]', rpc.INVALID_REQUEST, "one object a line"),
        (b'{"method": "halt"}', rpc.INVALID_REQUEST, 'jsonrpc: expected "2.0"'),
        (b'{"jsonrpc": "2.0", "method": 1}', rpc.INVALID_REQUEST, "method: expected the name"),
        (b'{"jsonrpc": "2.0", "method": "halt", "params": [1]}', rpc.INVALID_REQUEST, "params: expected an object"),
        (b'{"jsonrpc": "2.0", "method": "halt", "id": [1]}', rpc.INVALID_REQUEST, "id: expected"),
        (b'{"jsonrpc": "2.0", "method": "halt", "extra": 1}', rpc.INVALID_REQUEST, "unknown key 'extra'"),
        (b" " * (rpc.LINE_LIMIT + 1), rpc.INVALID_REQUEST, "more than"),
    ],
)
def test_what_is_no_request_is_refused_in_words(line, code, words):
    with pytest.raises(RpcError, match=words) as caught:
        rpc.parse(line)
    assert caught.value.code == code


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=20,
)


@given(st.binary(max_size=200) | json_values.map(lambda value: json.dumps(value).encode()))
def test_any_line_is_understood_or_refused(line):
    try:
        request = rpc.parse(line)
    except RpcError as error:
        message = msgspec.json.decode(rpc.failure(error))
        assert message["error"]["message"]
    else:
        assert request.method


# ---- the socket ------------------------------------------------------------------------------------------------------


def test_every_mistake_in_the_parameters_is_named_and_the_connection_goes_on(tmp_path):
    async def scenario(robot, client):
        error = await client.call("drive", speed="fast", spede=1)
        assert error["code"] == rpc.INVALID_PARAMS
        assert len(error["data"]["problems"]) == 3
        assert "did you mean 'speed'" in error["message"]
        error = await client.call("fly")
        assert error["code"] == rpc.UNKNOWN_METHOD
        assert "unknown method 'fly'" in error["message"]
        client.writer.write(b"nonsense\n")
        assert (await client.read())["error"]["code"] == rpc.PARSE_ERROR
        assert (await client.call("mission.status"))["state"] == "idle"

    operated(tmp_path, scenario)


def test_only_its_user_and_group_may_open_the_socket_and_it_is_gone_afterwards(tmp_path):
    async def scenario(robot, client):
        assert stat.S_IMODE(robot.path.stat().st_mode) == 0o660

    before = os.umask(0)
    try:
        robot = operated(tmp_path, scenario)
    finally:
        os.umask(before)
    assert not robot.path.exists()


def test_a_line_without_end_ends_that_connection_alone(tmp_path):
    async def scenario(robot, client):
        async with robot.connected() as other:
            other.writer.write(b"x" * (rpc.LINE_LIMIT + 4096))
            assert "a line has more than" in (await other.read())["error"]["message"]
            assert await other.reader.read() == b""
        assert (await client.call("mission.status"))["state"] == "idle"

    operated(tmp_path, scenario)


def test_too_many_clients_are_turned_away_and_there_is_room_again_when_one_goes(tmp_path):
    async def scenario(robot, client):
        others = [await asyncio.open_unix_connection(str(robot.path)) for _ in range(CLIENTS)]
        refused = json.loads(await others[-1][0].readline())
        assert f"{CLIENTS} clients" in refused["error"]["message"]
        for _, writer in others:
            writer.transport.abort()
        await asyncio.sleep(0.1)
        async with robot.connected() as other:
            assert await other.call("mission.status")

    operated(tmp_path, scenario)


def test_a_socket_left_by_a_dead_daemon_is_replaced_and_one_in_use_is_not(tmp_path):
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))

    async def main():
        first = asyncio.create_task(ControlSocket(path, None).run())
        await asyncio.sleep(0.1)
        with pytest.raises(InputError, match="another robotd listens there"):
            await ControlSocket(path, None).run()
        first.cancel()
        await asyncio.gather(first, return_exceptions=True)

    asyncio.run(main())
    (tmp_path / "file").touch()
    for place, words in (("file", "is no socket"), ("nowhere/control.sock", "no control socket: No such file")):
        with pytest.raises(InputError, match=words):
            run_virtual(ControlSocket(tmp_path / place, None).run())


def test_a_client_that_takes_nothing_costs_a_bounded_memory_and_is_cut_off(tmp_path):
    async def scenario(robot, client):
        client.writer.transport.pause_reading()
        client.send("subscribe", rate=20.0)
        await asyncio.sleep(60.0)
        async with robot.connected() as other:
            assert await other.call("mission.status")
        waiting = len(await client.reader.read()) if client.writer.transport.resume_reading() is None else 0
        assert waiting < 1 << 20

    operated(tmp_path, scenario)


def test_nonsense_from_a_client_neither_ends_the_daemon_nor_moves_the_robot_for_long(tmp_path):
    rng = np.random.default_rng(5)
    values = (None, True, -1, 0, 1e300, "x" * 300, [], {}, [[1]], "eye", "odometry", 0.1, 3, "base", "warning", "time")
    keys = sorted({item.name for params, _ in METHODS.values() for item in dataclasses.fields(params)})

    async def scenario(robot, client):
        for _ in range(30):
            async with robot.connected() as other:
                for _ in range(20):
                    chosen = [keys[k] for k in rng.integers(len(keys), size=rng.integers(4))]
                    params = {key: values[rng.integers(len(values))] for key in chosen}
                    other.send(list(METHODS)[rng.integers(len(METHODS))], **params)
                    if rng.random() < 0.2:
                        other.writer.write(rng.bytes(40).replace(b"\n", b"") + b"\n")
                await asyncio.sleep(0.2)
        await asyncio.sleep(5.0)
        await client.call("halt")
        await asyncio.sleep(BRAKING)
        assert not robot.course.is_moving
        assert (await client.call("status"))["robot"] == "trial"

    operated(tmp_path, scenario)


# ---- driving ---------------------------------------------------------------------------------------------------------


async def drive(client, seconds, speed=0.2, turn_rate=0.0):
    """Repeat a wish for so long, as robotctl drive does."""
    end = now() + seconds
    while now() < end:
        answer = await client.call("drive", t=now() + 1000.0, speed=speed, turn_rate=turn_rate)
        await asyncio.sleep(0.05)
    return answer


def last_drive(robot):
    return robot.course.wire.drives[-1][1:]


def test_the_robot_drives_while_the_wish_is_repeated_and_halts_by_itself_when_it_is_not(tmp_path):
    async def scenario(robot, client):
        answer = await drive(client, 1.5)
        assert answer["counted"]
        assert robot.course.is_moving
        await asyncio.sleep(0.2 + BRAKING)
        assert not robot.course.is_moving
        assert last_drive(robot) == (0, 0)

    operated(tmp_path, scenario)


def test_a_client_that_vanishes_while_it_drives_halts_the_robot_at_once(tmp_path):
    async def scenario(robot, client):
        async with robot.connected() as other:
            await drive(other, 1.5)
            assert robot.course.is_moving
            sent, gone = len(robot.course.wire.drives), now()
            other.hang_up()
            await asyncio.sleep(0.03)
        assert any(
            speeds == (0, 0) and t - gone < 0.02
            for t, *rest in robot.course.wire.drives[sent:]
            if (speeds := tuple(rest))
        )
        await asyncio.sleep(BRAKING)
        assert not robot.course.is_moving
        assert robot.said("stopped: the connection to")

    operated(tmp_path, scenario)


def test_wishes_that_a_stalled_connection_held_back_do_not_move_the_robot(tmp_path):
    async def scenario(robot, client):
        await drive(client, 1.0)
        await asyncio.sleep(2.0)
        where = robot.course.travelled
        for k in range(40):  # two seconds of wishes, all at once
            answer = await client.call("drive", t=now() + 998.0 - 0.05 * (40 - k), speed=0.2)
            assert not answer["counted"]
        await asyncio.sleep(0.5)
        assert robot.course.travelled == where
        assert (await drive(client, 0.2))["counted"]  # it has caught up

    operated(tmp_path, scenario)


def test_clocks_that_drift_apart_do_not_stop_a_long_drive(tmp_path):
    async def scenario(robot, client):
        for _ in range(400):
            answer = await client.call("drive", t=0.998 * now(), turn_rate=0.3)
            assert answer["counted"]
            await asyncio.sleep(0.1)

    operated(tmp_path, scenario)


def test_one_client_drives_at_a_time_and_anybody_may_stop_it(tmp_path):
    async def scenario(robot, client):
        await drive(client, 1.0)
        async with robot.connected() as other:
            assert "is driving" in (await other.call("drive", t=0.0, speed=0.1))["message"]
            assert await other.call("halt") == {}
            answer = await drive(client, 1.0)  # the stick is still held
            assert "stopped by" in answer["held"]
            assert not robot.course.is_moving
            await drive(client, 0.3, speed=0.0)
            await drive(client, 1.0)
            assert robot.course.is_moving
            await client.call("drive", t=now() + 1000.0)
            await asyncio.sleep(1.5)  # silent: let go
            assert (await drive(other, 0.5))["counted"]

    operated(tmp_path, scenario)


def test_an_emergency_stop_holds_until_it_is_released(tmp_path):
    async def scenario(robot, client):
        await drive(client, 1.0)
        assert "emergency stop" in (await client.call("estop"))["latched"]
        await asyncio.sleep(BRAKING + 0.1)
        assert "emergency stop" in (await drive(client, 0.5))["held"]
        assert not robot.course.is_moving
        assert "emergency stop" in (await client.call("mission.start"))["message"]
        assert (await client.call("release"))["latched"] is None
        await drive(client, 1.0)
        assert robot.course.is_moving

    operated(tmp_path, scenario)


# ---- telemetry -------------------------------------------------------------------------------------------------------


def test_status_has_all_of_one_screen_and_can_be_sent(tmp_path):
    async def scenario(robot, client):
        status = await client.call("status")
        assert {"pose", "base", "mission", "drivers", "uploads", "held"} <= status.keys()
        assert [item["name"] for item in status["drivers"]] == ["base", "eye", "labels", "follower"]
        assert status["drivers"][0]["counters"]["frames"] > 10
        assert (await client.call("drivers.restart", name="eye")) == {}
        await asyncio.sleep(0.5)
        eye = (await client.call("drivers.list"))["drivers"][1]
        assert (eye["state"], eye["restarts"]) == ("ok", 1)
        assert "there is no driver 'nose'" in (await client.call("drivers.restart", name="nose"))["message"]
        assert "no beacons" in (await client.call("beacons"))["message"]
        assert (await client.call("wake"))["text"] == "the base is awake"

    operated(tmp_path, scenario)


def test_a_subscriber_gets_samples_at_its_rate_and_every_event(tmp_path):
    async def scenario(robot, client):
        client.send("subscribe", rate=10.0)
        start = now()
        await asyncio.sleep(0.3)
        async with robot.connected() as other:
            await other.call("drivers.restart", name="eye")
        messages = []
        while not messages or messages[-1].get("params", {}).get("t", 0.0) < start + 5.0:
            messages.append(await client.read())
        samples = [message["params"] for message in messages if message["method"] == "telemetry"]
        assert 49 <= len(samples) <= 52
        assert any("restarted by" in message["params"]["text"] for message in messages if message["method"] == "event")

    robot = operated(tmp_path, scenario)
    assert robot.course.bus.events._subscriptions == []


def test_the_log_is_read_back_with_dates_and_levels(tmp_path):
    async def scenario(robot, client):
        await client.call("drivers.restart", name="eye")
        await drive(client, 1.0)
        await client.call("halt")
        await asyncio.sleep(0.5)
        every = (await client.call("logs"))["events"]
        assert any("restarted by" in event["text"] for event in every)
        assert all(event["utc"].startswith("2026-03-02T") for event in every)
        loud = (await client.call("logs", level="warning"))["events"]
        assert 0 < len(loud) < len(every)
        assert (await client.call("logs", after=every[-1]["number"]))["events"] == []

    operated(tmp_path, scenario)
