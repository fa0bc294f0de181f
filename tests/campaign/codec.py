"""The long run of the codec: 10^8 adversarial bytes, and streams with line faults. Size: ROBOTD_CODEC_BYTES."""

import os

import numpy as np

from robotd import oi
from tests.fuzz.adversary import BASE, Score, damaged, judge, unbroken

SIZE = int(os.environ.get("ROBOTD_CODEC_BYTES", "100000000"))


def test_no_false_frame_in_a_hundred_million_adversarial_bytes():
    score, clear = Score(), Score()
    for number, stream in enumerate(unbroken(np.random.default_rng(100), SIZE)):
        kind = "auto" if number % 3 == 0 else None
        if oi.StreamLayout(stream.packet_ids).lookalikes:
            judge(stream, score, kind)
        else:
            judge(stream, clear, kind)
    print(f"\nadversarial: {clear}, where data can imitate a frame: {score}")
    assert score.bytes + clear.bytes >= SIZE
    assert score.false == clear.false == 0
    assert clear.found == clear.sent
    assert score.found > score.sent / 2


def test_line_faults_let_no_more_false_frames_through_than_the_sum_allows():
    """Of the windows that have their ids in order in spite of the damage one in 256 has the right sum."""
    score, rng = Score(), np.random.default_rng(101)
    for stream in unbroken(rng, SIZE // 20, [BASE]):
        decoder = oi.StreamDecoder(stream.packet_ids, stream.checksum)
        contents = [decoder.layout.decode(frame) for frame in set(stream.frames.values())]
        for event in decoder.feed(damaged(stream, rng, 0.001)):
            if isinstance(event, oi.SensorValues):
                score.found += 1
                score.false += event.values not in contents
        score.sent += len(stream.frames)
    hurt = score.sent - score.found
    print(f"\none byte in 1000 damaged: {hurt} of {score.sent} frames lost, {score.false} accepted with wrong values")
    assert score.false <= 5 + 2 * hurt / 256
