"""The network camera's driver against a real HTTP server on loopback, in virtual and in real time."""

import asyncio
import shutil
import ssl
import subprocess
from contextlib import asynccontextmanager

import cv2
import numpy as np
import pytest
from robotd.drivers.mjpeg import MjpegConfig, MjpegDriver

from robotd import jpeg
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault
from robotd.hardware import CameraMode
from robotd.plugin import Camera
from robotd.sim.mjpeg_server import MjpegServer, NetworkCameraSettings

SIZE = (64, 48)
MODE = CameraMode(size=SIZE)


def clock_face(t):
    """An image whose brightness tells the time of its exposure: 10 ms a grey level, modulo 2 s."""
    return np.full((SIZE[1], SIZE[0]), 20 + round(100 * (t % 2.0)), np.uint8)


@asynccontextmanager
async def a_camera(render=clock_face, seed=1, wire=None, tls=None, **settings):
    server = MjpegServer(render, NetworkCameraSettings(**settings), seed=seed, wire=wire)
    url = await server.start(tls=tls)
    try:
        yield server, url
    finally:
        await server.close()


def a_driver(url, **config):
    return MjpegDriver("roof", MjpegConfig(url, **config), None, Bus(), Calibration())


@asynccontextmanager
async def running(driver, mode=MODE):
    try:
        await driver.open()
        await driver.start(mode)
        task = asyncio.create_task(driver.run())
        try:
            yield task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    finally:
        await driver.close()


async def collect(driver, count):
    with driver.bus.frames("roof").subscribe(size=1000) as frames:
        return [await frames.get() for _ in range(count)]


def errors_of(frames):
    """Stamp minus true time of the exposure in seconds, to 10 ms, as the image tells it."""
    shown = np.array([(float(frame.image.mean()) - 20) / 100 for frame in frames])
    return (np.array([frame.t for frame in frames]) - shown + 1.0) % 2.0 - 1.0


def run(steps, **settings):
    """Virtual time: `steps(server, url)` beside a camera."""

    async def main():
        async with a_camera(**settings) as (server, url):
            return await steps(server, url)

    return run_virtual(main())


# ---- frames ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lengths", [True, False])
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize(
    ("boundary", "delimiter"),
    [("frame", "--frame"), ("--frame", "--frame"), ('"--my frame"', "--my frame"), ("frame", "frame")],
)
def test_frames_come_from_every_kind_of_multipart(lengths, chunked, boundary, delimiter):
    async def steps(server, url):
        driver = a_driver(url)
        assert isinstance(driver, Camera)
        async with running(driver):
            frames = await collect(driver, 30)
        assert [frame.sequence for frame in frames] == list(range(30))
        assert all(frame.image.shape == (48, 64) and frame.camera == "roof" for frame in frames)
        assert all(not frame.image.flags.writeable for frame in frames)
        gaps = np.diff([frame.t for frame in frames])
        assert np.all(np.abs(gaps[10:] - 0.04) < 0.015)

    run(steps, lengths=lengths, chunked=chunked, boundary=boundary, delimiter=delimiter)


def test_nothing_comes_before_start_and_after_stop_and_no_connection_stays():
    async def steps(server, url):
        driver = a_driver(url)
        async with running(driver):
            await collect(driver, 3)
            await driver.stop()
            with driver.bus.frames("roof").subscribe() as frames:
                await asyncio.sleep(2.0)
                assert len(frames._items) == 0
            await driver.start(MODE)
            await collect(driver, 3)
            assert server.connections == 3, "one to open, one for each stream"
        await asyncio.sleep(1.0)
        assert len(server._clients) == 0
        assert driver.counters.streams == 2

    run(steps)


def test_the_red_channel_is_given_where_it_is_wanted():
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:] = (200, 30, 90)  # blue, green, red

    async def steps(server, url):
        for channel, level in (("red", 90), ("gray", 67)):
            driver = a_driver(url, channel=channel)
            async with running(driver):
                (frame,) = await collect(driver, 1)
            assert abs(float(frame.image.mean()) - level) < 3

    run(steps, render=lambda t: picture)


def test_a_larger_image_is_decoded_to_the_size_asked_for_and_another_is_a_fault():
    async def steps(server, url):
        driver = a_driver(url)
        async with running(driver, CameraMode((32, 24))):
            (frame,) = await collect(driver, 1)
            assert frame.image.shape == (24, 32)
            assert jpeg.read_header(frame.encoded)[:2] == (64, 48), "as the camera sent it"
        async with running(a_driver(url), CameraMode((40, 30))) as task:
            with pytest.raises(DriverFault, match="gives 64x48 pixels instead of 40x30 or 2, 4 or 8 times that"):
                await task

    run(steps)


# ---- time ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("header", ["X-Timestamp", "x-my-clock"])
def test_capture_stamps_date_frames_to_a_constant(header):
    async def steps(server, url):
        driver = a_driver(url, stamp_header=None if header == "X-Timestamp" else header)
        async with running(driver):
            await collect(driver, 250)
            return errors_of(await collect(driver, 250))

    errors = run(steps, stamps=header, clock_skew=50e-6, fps=10.0, delay_min=0.05, delay_max=0.15)
    assert abs(float(np.median(errors)) - 0.05) < 0.01, "the least delay cannot be observed"
    assert np.ptp(errors) < 0.012, "10 ms is what the image tells"


def test_the_least_delay_is_subtracted_where_it_is_known():
    async def steps(server, url):
        driver = a_driver(url, delay_s=0.05)
        async with running(driver):
            await collect(driver, 100)
            return errors_of(await collect(driver, 100))

    assert np.abs(run(steps, delay_min=0.05, delay_max=0.15)).max() < 0.012


def test_without_stamps_the_frames_are_dated_more_evenly_than_they_arrive():
    async def steps(server, url):
        driver = a_driver(url)
        async with running(driver):
            await collect(driver, 100)
            return errors_of(await collect(driver, 400))

    errors = run(steps, stamps=None, fps=10.0, delay_min=0.05, delay_max=0.09)
    assert np.std(errors) < 0.008, "arrivals scatter by 11.5 ms, and the image tells to 3 ms"


# ---- logging in ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("login", ["basic", "digest"])
def test_it_logs_in_as_the_camera_wants_and_the_password_is_never_told(login, tmp_path, caplog):
    (tmp_path / "password").write_text("secret\n")
    (tmp_path / "password").chmod(0o600)

    async def steps(server, url):
        driver = a_driver(url, user="viewer", password_file=tmp_path / "password")
        with driver.bus.events.subscribe() as events:
            async with running(driver):
                await collect(driver, 3)
            told = " ".join(event.text for event in events._items)
        assert ("unencrypted" in told) == (login == "basic")
        assert "secret" not in told
        (tmp_path / "password").write_text("wrong\n")
        with pytest.raises(DriverFault, match=r"refuses us \(401\); check user and password_file") as caught:
            async with running(driver):
                pass
        assert "wrong" not in str(caught.value)
        with pytest.raises(DriverFault, match=r"refuses us \(401\); give user and password_file"):
            async with running(a_driver(url)):
                pass

    run(steps, login=login)
    assert "secret" not in caplog.text


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (None, "cannot be read: No such file"),
        (b"\n", "is empty"),
        (b"\xff\xfe", "printable ASCII"),
        (b"open", "chmod 0600"),
    ],
)
def test_a_password_file_that_is_none_is_named(content, match, tmp_path):
    path = tmp_path / "password"
    if content is not None:
        path.write_bytes(content)
        path.chmod(0o644 if content == b"open" else 0o600)

    async def main():
        with pytest.raises(DriverFault, match=f"password_file: .*{match}"):
            await a_driver("http://127.0.0.1:1/", user="x", password_file=path).open()

    run_virtual(main())


# ---- what goes wrong -------------------------------------------------------------------------------------------------


def test_a_connection_that_breaks_is_made_again_and_told_once():
    async def steps(server, url):
        driver = a_driver(url)
        with driver.bus.events.subscribe() as events:
            async with running(driver):
                frames = await collect(driver, 25)
            texts = [event.text for event in events._items]
        assert [frame.sequence for frame in frames] == list(range(25))
        assert np.all(np.diff([frame.t for frame in frames]) > 0)
        assert server.connections == 4
        assert len(texts) == 2
        assert all("closed the connection; connecting again" in text for text in texts)

    run(steps, wire=lambda number, part: (part, None) if number == 9 else (part,))


def test_a_camera_that_falls_silent_is_connected_to_again_and_then_is_a_fault():
    async def steps(server, url):
        driver = a_driver(url, stall_s=2.0, patience_s=10.0)
        begun = now()
        async with running(driver) as task:
            await collect(driver, 5)
            with pytest.raises(DriverFault, match=r"has sent no whole frame for 2 s; no frame for 1. s"):
                await task
        assert 10.0 <= now() - begun < 14.0
        assert server.connections >= 4

    def wire(number, part):
        wire.sent += 1
        return (part,) if wire.sent <= 20 else (100.0,)

    wire.sent = 0
    run(steps, wire=wire)


def test_a_dribble_of_bytes_is_no_frame():
    async def steps(server, url):
        driver = a_driver(url, stall_s=1.0, patience_s=5.0)
        async with running(driver) as task:
            with pytest.raises(DriverFault, match="has sent no whole frame for 1 s"):
                await task

    run(steps, wire=lambda number, part: [piece for byte in part[:200] for piece in (bytes([byte]), 0.2)])


def test_frames_that_come_in_pieces_are_put_together():
    async def steps(server, url):
        driver = a_driver(url)
        async with running(driver):
            frames = await collect(driver, 20)
        assert [frame.sequence for frame in frames] == list(range(20))

    def wire(number, part):
        return [piece for at in range(0, len(part), 100) for piece in (part[at : at + 100], 0.001)]

    run(steps, wire=wire)


def test_truncated_images_are_counted_and_left_out():
    async def steps(server, url):
        driver = a_driver(url)
        async with running(driver):
            frames = await collect(driver, 20)
            counters = driver.counters
        assert [frame.sequence for frame in frames] == [k for k in range(40) if k % 2][:20]
        assert 19 <= counters.damaged <= 21

    def wire(number, part):
        return (part,) if number % 2 else (part[:-90] + b"\r\n",)

    run(steps, wire=wire, lengths=False)


def test_something_else_than_images_is_a_fault():
    async def steps(server, url):
        async with running(a_driver(url)) as task:
            with pytest.raises(DriverFault, match="sends something else than JPEG images"):
                await task

    run(steps, wire=lambda number, part: (b"--frame\r\nContent-Length: 4\r\n\r\nabcd\r\n",))


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        (
            {"status": "302 Found", "location": "http://elsewhere.example/x?token=1"},
            "redirects to http://elsewhere.example/x;",
        ),
        ({"status": "404 Not Found"}, "answers 404 Not Found; check the path in url"),
        ({"status": "403 Forbidden"}, r"refuses us \(403\); give user"),
        ({"status": "503 Service Unavailable"}, "has an error of its own"),
        ({"content_type": "image/jpeg"}, "expected multipart/x-mixed-replace; url gives single pictures"),
        ({"content_type": "text/html"}, "Content-Type is 'text/html'; expected multipart"),
    ],
)
def test_an_answer_that_is_no_stream_is_a_fault_with_its_mend(settings, match):
    async def steps(server, url):
        with pytest.raises(DriverFault, match=match) as caught:
            async with running(a_driver(url + "?password=hidden")):
                pass
        assert "hidden" not in str(caught.value)
        assert "token" not in str(caught.value)

    run(steps, **settings)


def test_a_camera_that_is_not_there_is_a_fault():
    async def main():
        async with a_camera() as (_, url):
            pass
        with pytest.raises(DriverFault, match=r"cannot be reached .*; check address, network and power"):
            async with running(a_driver(url)):
                pass

    run_virtual(main())


def test_a_slow_decoder_gets_the_newest_parts(monkeypatch):
    async def steps(server, url):
        driver = a_driver(url)

        async def slow(function, *arguments):
            await asyncio.sleep(0.2)
            return function(*arguments)

        monkeypatch.setattr("robotd.drivers.mjpeg.in_thread", slow)
        async with running(driver):
            frames = await collect(driver, 20)
            assert now() - frames[-1].t < 0.2 + 5 * 0.04 + 0.1
            assert driver.counters.dropped > 60
            await asyncio.sleep(25.0)
        assert driver.counters.age > 0.2

    run(steps)


def test_missing_frames_are_told_in_words():
    async def steps(server, url):
        driver = a_driver(url, fps=25.0)
        with driver.bus.events.subscribe() as events:
            async with running(driver):
                await asyncio.sleep(25.0)
            told = [event.text for event in events._items]
        assert told == ["only 9.9 of 25 frames a second"] or told == ["only 10.0 of 25 frames a second"]
        assert driver.counters.rate == pytest.approx(10.0, abs=0.6)

    run(steps, fps=10.0)


# ---- real time and TLS -----------------------------------------------------------------------------------------------


def test_it_runs_in_real_time_too():
    async def main():
        async with a_camera(fps=100.0, delay_min=0.0, delay_max=0.001) as (_, url):
            driver = a_driver(url)
            async with running(driver):
                frames = await collect(driver, 20)
        assert [frame.sequence for frame in frames] == list(range(20))
        assert driver.counters.decode_s > 0.0

    asyncio.run(main())


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")
def test_a_certificate_is_verified(tmp_path):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    arguments = ["-nodes", "-days", "2", "-subj", "/CN=camera", "-addext", "subjectAltName=IP:127.0.0.1"]
    arguments += ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run(["openssl", "req", "-x509", "-newkey", "rsa:2048", *arguments], check=True, capture_output=True)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate, key)

    async def main():
        async with a_camera(tls=tls, fps=50.0) as (_, url):
            with pytest.raises(DriverFault, match=r"is not trusted .*; give the certificate that signed it as ca_file"):
                async with running(a_driver(url)):
                    pass
            driver = a_driver(url, ca_file=certificate)
            async with running(driver):
                await collect(driver, 3)
            key.write_text("none")
            with pytest.raises(DriverFault, match=r"ca_file .* cannot be used"):
                await a_driver(url, ca_file=key).open()

    asyncio.run(main())


# ---- its section -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "match"),
    [
        ({"url": "camera/video"}, "expected an address such as http://192"),
        ({"url": "rtsp://10.0.0.1/x"}, "found 'rtsp://10.0.0.1/x'; expected an address"),
        ({"url": "http://10.0.0.1:99999/"}, "Port out of range"),
        ({"url": "http://me:secret@10.0.0.1/"}, "use the keys user, password_file"),
        ({"url": "http://10.0.0.1/", "user": "x"}, "belong together"),
        ({"url": "http://10.0.0.1/", "ca_file": "x"}, "nothing to verify with http"),
        ({"url": "http://10.0.0.1/", "channel": "blue"}, "expected one of .gray., .red."),
        ({"url": "http://10.0.0.1/", "stall_s": 0}, "stall_s: found 0; expected 0.2 to 60"),
    ],
)
def test_the_section_is_checked(section, match):
    with pytest.raises(ConfigError, match=match) as caught:
        bind(MjpegConfig, section, "x")
    assert "secret" not in str(caught.value)


def test_decoding_uses_the_image_as_it_is():
    image = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (48, 1))
    expected = cv2.imdecode(cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 80))[1], cv2.IMREAD_GRAYSCALE)

    async def steps(server, url):
        driver = a_driver(url)
        async with running(driver):
            (frame,) = await collect(driver, 1)
        assert np.array_equal(frame.image, expected)

    run(steps, render=lambda t: image)
