"""JPEG decoding to one channel, the queue of frames, and the figures that tell how a camera does."""

import asyncio

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.camera_feed import CameraMeter, FrameQueue
from robotd.errors import DriverFault
from robotd.hardware import CameraCounts
from robotd.jpeg import decode, read_header, reduction
from robotd.records import Frame

RNG = np.random.default_rng(4)
PICTURE = cv2.GaussianBlur(RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8), (0, 0), 2)


def encode(image, *flags):
    return cv2.imencode(".jpg", image, flags)[1].tobytes()


def without_tables(data):
    """The same without its Huffman tables, as many USB cameras send it."""
    out, at = data[:2], 2
    while data[at + 1] != 0xDA:
        length = 2 + (data[at + 2] << 8 | data[at + 3])
        out += b"" if data[at + 1] == 0xC4 else data[at : at + length]
        at += length
    return out + data[at:]


def test_grey_is_the_decoders_own_luminance_and_red_its_red():
    data = encode(PICTURE)
    assert np.array_equal(decode(data), cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE))
    whole = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decode(data, channel="red"), whole[:, :, 2])


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
@pytest.mark.parametrize("channel", ["gray", "red"])
def test_a_larger_image_is_decoded_to_a_fraction_of_its_size(factor, channel):
    large = encode(cv2.resize(PICTURE, (64 * factor, 48 * factor), interpolation=cv2.INTER_CUBIC))
    small = decode(large, (64, 48), channel)
    assert small.shape == (48, 64)
    whole = decode(large, channel=channel)
    expected = cv2.resize(whole, (64, 48), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).mean() < 2.5
    assert reduction((64 * factor, 48 * factor), (64, 48)) == factor


def test_odd_sizes_are_rounded_up_and_other_sizes_refused():
    assert decode(encode(np.zeros((33, 51), np.uint8)), (26, 17)).shape == (17, 26)
    assert reduction((64, 48), (63, 48)) is None
    assert decode(encode(PICTURE), (63, 48)) is None


def test_images_without_huffman_tables_and_with_padding_are_whole():
    data = encode(PICTURE)
    assert np.array_equal(decode(without_tables(data)), decode(data))
    assert np.array_equal(decode(data + bytes(700)), decode(data))
    assert np.array_equal(decode(memoryview(data)), decode(data))


def test_the_header_tells_the_size():
    header = read_header(encode(PICTURE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1))
    assert header[:2] == (64, 48)
    assert read_header(encode(PICTURE)[:100]) is None


@given(st.integers(0, 2000))
@settings(deadline=None, max_examples=60)
def test_an_image_that_was_cut_off_is_refused(cut):
    data = encode(PICTURE)
    assert decode(data[: min(cut, len(data) - 2)]) is None


@given(st.one_of(st.binary(max_size=300), st.binary(max_size=60).map(lambda noise: b"\xff\xd8" + noise + b"\xff\xd9")))
@settings(deadline=None, max_examples=200)
def test_noise_is_refused_and_never_raises(noise):
    assert decode(noise) is None


# ---- the queue -------------------------------------------------------------------------------------------------------


def frame(k):
    return Frame("front", k / 30, np.zeros((2, 2), np.uint8), k)


def test_a_full_queue_gives_up_its_oldest_frame_and_counts_it():
    async def main():
        counts = CameraCounts()
        queue = FrameQueue(counts, size=3)
        for k in range(5):
            queue.put(frame(k))
        assert counts.dropped == 2
        queue.fail("unplugged")
        assert [(await queue.get()).sequence for _ in range(3)] == [2, 3, 4]
        with pytest.raises(DriverFault, match="unplugged"):
            await queue.get()

    asyncio.run(main())


# ---- the figures -----------------------------------------------------------------------------------------------------


def filmed(seconds=10.0, fps=30.0, age=0.05, **counts):
    """A meter after a stream of so many seconds, and the time at its end."""
    meter, kept = CameraMeter(), CameraCounts()
    meter.begin(kept, 100.0)
    for k in range(round(seconds * fps)):
        t = 100.0 + k / fps
        meter.add(Frame("front", t - age, np.zeros((2, 2), np.uint8), k), t)
    for name, value in counts.items():
        setattr(kept, name, value)
    return meter, 100.0 + seconds


def test_rate_age_and_cost_are_means():
    meter, t = filmed(decoded=300, decode_s=0.6, lost=3)
    counters = meter.read(t)
    assert counters.rate == pytest.approx(30.0, abs=0.5)
    assert counters.age == pytest.approx(0.05)
    assert counters.decode_s == pytest.approx(0.002)
    assert (counters.published, counters.lost, counters.streams) == (300, 3, 1)
    assert meter.read(t + 5.0).rate == 0.0


def test_a_camera_that_does_well_is_not_talked_about():
    meter, t = filmed(decoded=300, decode_s=0.6, lost=5, damaged=2, dropped=1)
    assert meter.complaints(t, 30.0) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 15.0}, "only 15.0 of 30 frames a second"),
        ({"lost": 20}, "20 of 320 frames never arrived: the bus or the network is too slow"),
        ({"damaged": 20}, "20 of 320 frames are damaged: check cable, hub and power supply"),
        ({"dropped": 20}, "20 of 320 frames were dropped: this computer is too slow for them"),
        ({"age": 0.8}, "frames are 0.8 s old when they come"),
        ({"decoded": 300, "decode_s": 6.0}, "decoding takes 20 ms a frame, most of a core"),
    ],
)
def test_what_is_bad_is_said_in_words_once(changes, words):
    meter, t = filmed(**changes)
    assert meter.complaints(t, 30.0) == [words]


def test_counts_go_on_over_streams():
    meter, t = filmed(lost=3)
    meter.begin(CameraCounts(lost=4), t)
    assert (meter.read(t).lost, meter.read(t).streams) == (7, 2)
