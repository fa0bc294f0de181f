"""The workbench: marks, scores, tuning, pictures and playing of footage, by its command line."""

import io
import json
import math
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.clock import now, run_virtual
from robotd.errors import InputError
from robotd.recording import FrameRecorder, read_contents, read_frames
from robotd.records import Flash, Frame
from robotd.solver_main import main
from robotd.vision.figures import GREEN, GREY, RED, SKY, YELLOW
from robotd.vision.pattern import FlashPattern
from robotd.workbench.detectors import make_detector, read_settings, recorded_settings
from robotd.workbench.pictures import Seen, overlay, plot
from robotd.workbench.player import Player
from robotd.workbench.score import Score, judge, wilson
from robotd.workbench.sequence import judge_clips, open_all, open_tagged, steps
from robotd.workbench.tags import Tag, add_tag, load_tags, remove_tags, save_tags, tags_path
from robotd.workbench.trace import Trace
from robotd.workbench.tune import Range, objective, parse_range, tune

LIGHTS = ((30.3, 20.6), (70.8, 50.2), (100.4, 24.9))
SIZE = (128, 80)


def film(seconds=4.0, lights=LIGHTS, fps=30.0, seed=1, until=math.inf):
    """Noisy frames of lights that flash in the usual pattern; after `until` they are dark."""
    rng = np.random.default_rng(seed)
    pattern = FlashPattern()
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    texture = cv2.GaussianBlur(rng.uniform(60, 120, (SIZE[1], SIZE[0])).astype(np.float32), (0, 0), 3.0)
    spots = [np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.1**2)) for x, y in lights]
    for k in range(round(seconds * fps)):
        t = k / fps
        image = texture + rng.normal(0.0, 1.5, texture.shape)
        for number, spot in enumerate(spots):
            share = pattern.coverage(np.array([(t - 0.21 * number) % 1.0]), 0.010, 2)[0] if t < until else 0.0
            image = image + 60.0 * share * spot
        yield Frame("front", 50.0 + t, np.clip(np.rint(image), 0, 255).astype(np.uint8), k)


def write(path, frames, *, jpeg=False, camera="front", **about):
    with FrameRecorder(path, about={"gamma": "1.0", **about}) as recorder:
        for frame in frames:
            encoded = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes() if jpeg else None
            image = cv2.imdecode(np.frombuffer(encoded, np.uint8), 0) if jpeg else frame.image
            recorder.frame(Frame(camera, frame.t, image, frame.sequence, encoded), frame.t, {"channel": "gray"})
    return path


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """A recording of three lights, all marked; not to be written to."""
    path = write(tmp_path_factory.mktemp("shelf") / "shelf.mcap", film())
    save_tags([Tag(u, v, label=f"A{k}") for k, (u, v) in enumerate(LIGHTS)], tags_path(path))
    return path


def bench(capsys, *arguments):
    """Run a command with --json; returns what it prints."""
    code = main(["workbench", *map(str, arguments), "--json"])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    return json.loads(printed.out)


def refused(capsys, *arguments):
    assert main(["workbench", *map(str, arguments)]) == 2
    return capsys.readouterr().err


# ---- marks -----------------------------------------------------------------------------------------------------------

tags = st.builds(
    Tag,
    u=st.floats(0, 600),
    v=st.floats(0, 400),
    kind=st.sampled_from(["label", "reflection", "ignore"]),
    camera=st.sampled_from([None, "front", "le ft"]),
    label=st.one_of(st.none(), st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=20)),
    since=st.floats(0, 10),
    until=st.one_of(st.none(), st.floats(11, 20)),
    radius=st.floats(0.1, 50),
)


@settings(deadline=None, max_examples=50)
@given(st.lists(tags, max_size=5))
def test_marks_come_back_as_they_were_saved(tmp_path_factory, marks):
    path = tmp_path_factory.mktemp("tags") / "x.tags.toml"
    save_tags(marks, path)
    assert load_tags(path) == marks
    assert load_tags(path, "front") == [tag for tag in marks if tag.camera in (None, "front")]


def test_a_mark_outside_of_the_images_is_named_and_not_counted_as_missed(tmp_path, capsys):
    path = write(tmp_path / "one.mcap", film())
    save_tags([Tag(99999.0, 3.0)], tags_path(path))
    assert "one.mcap.tags.toml: mark at 99999,3 is outside of the image" in refused(capsys, "score", path)


def test_every_mistake_in_a_file_of_marks_is_named(tmp_path):
    path = tmp_path / "x.tags.toml"
    path.write_text(
        'format = "robotd-tags/2"\n[[tags]]\nu = 1.0\nv = "b"\n[[tags]]\nu = 1.0\nv = 2.0\nknd = "label"\n'
        "[[tags]]\nu = 1.0\nv = 2.0\nsince = 5.0\nuntil = 4.0\n"
    )
    with pytest.raises(InputError) as caught:
        load_tags(path)
    assert len(caught.value.problems) == 4
    assert "did you mean 'kind'" in str(caught.value)
    assert load_tags(tmp_path / "none.toml") == []


def test_a_mark_outside_or_on_another_one_is_refused():
    one = Tag(10.0, 10.0)
    assert add_tag([one], Tag(10.0, 20.0), (64, 48))[1].v == 20.0
    assert add_tag([one], Tag(10.5, 10.0, "reflection"), (64, 48))
    with pytest.raises(InputError, match="outside of the image of 64x48"):
        add_tag([one], Tag(64.0, 10.0), (64, 48))
    with pytest.raises(InputError, match="is mark 1 already"):
        add_tag([one], Tag(10.5, 10.0), (64, 48))
    with pytest.raises(InputError, match="no mark 2; there are 1"):
        remove_tags([one], [2])


def test_marks_are_added_proposed_accepted_removed_and_drawn(tmp_path, capsys, shelf):
    path = tmp_path / "a.mcap"
    path.write_bytes(shelf.read_bytes())
    bench(capsys, "tag", path, "--add", "30,20", "--label", "A0", "--until", "3")
    done = bench(capsys, "tag", path, "--propose", "--picture", tmp_path / "x.png")
    assert [tag["label"] for tag in done["tags"]] == ["A0"]
    found = sorted((round(p["u"]), round(p["v"])) for p in done["proposals"])
    assert found == [(71, 50), (100, 25)]
    picture = cv2.imread(str(tmp_path / "x.png"))
    assert picture.shape[1] == 2 * SIZE[0]
    assert len(bench(capsys, "tag", path, "--accept-all")["tags"]) == 3
    done = bench(capsys, "tag", path, "--remove", "1", "--add", "5,5", "--kind", "ignore", "--radius", "9")
    assert [tag["kind"] for tag in done["tags"]] == ["label", "label", "ignore"]
    assert load_tags(tags_path(path))[2].radius == 9.0
    assert "no proposal 7; there are 1" in refused(capsys, "tag", path, "--accept", "7")


# ---- scores ----------------------------------------------------------------------------------------------------------


def at(*places):
    return [Flash(u, v, 0.1, 10.0) for u, v in places]


def test_findings_are_paired_with_labels_nearest_first():
    labels = [Tag(10.0, 10.0), Tag(13.0, 10.0), Tag(40.0, 40.0)]
    found = at((12.2, 10.0), (11.9, 10.0), (60.0, 60.0), (80.0, 80.0), (90.0, 20.0))
    verdict = judge(found, labels, [Tag(60.5, 60.0)], [Tag(85.0, 80.0, radius=6.0)])
    assert verdict.pairs == ((0, 1), (1, 0))
    assert verdict.missed == (2,)
    assert (verdict.false, verdict.mirrored, verdict.ignored) == ((2, 4), (2,), (3,))


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20)), max_size=8),
    st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20)), max_size=8),
)
def test_every_label_and_finding_is_counted_once(labels, found):
    verdict = judge(at(*found), [Tag(float(u), float(v)) for u, v in labels])
    assert len(verdict.pairs) + len(verdict.missed) == len(labels)
    assert len(verdict.pairs) + len(verdict.false) == len(found)
    assert len({j for _, j in verdict.pairs}) == len(verdict.pairs)
    for k in verdict.missed:
        for j in verdict.false:
            assert math.hypot(labels[k][0] - found[j][0], labels[k][1] - found[j][1]) >= 2.5


def test_spread_is_the_deviation_of_each_label_about_its_own_mean():
    rng = np.random.default_rng(1)
    score = Score()
    for k in range(400):
        labels = [Tag(10.0, 10.0), Tag(50.0, 20.0)]
        found = at(*((tag.u + 0.4 + 0.1 * rng.normal(), tag.v + 0.2 * rng.normal()) for tag in labels))
        score.add(found, labels, name=str(k), keys=["a", "b"])
    assert score.spread_px == pytest.approx(math.sqrt((0.1**2 + 0.2**2) / 2), rel=0.1)
    assert score.rms_px == pytest.approx(math.sqrt((0.4**2 + 0.1**2 + 0.2**2) / 2), rel=0.1)
    assert (score.recall, score.precision, score.f1) == (1.0, 1.0, 1.0)
    assert Score().table()["recall"] is None
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(96, 100)
    assert (low, high) == pytest.approx((0.9016, 0.9843), abs=1e-3), "Wilson's own formula, worked by hand"


def test_a_tagged_recording_is_judged_in_clips_and_after_a_time(capsys, shelf):
    done = bench(capsys, "score", shelf, "--clip", "2", "--after", "1")
    assert done["scores"]["end"]["clips"] == 2
    assert done["scores"]["end"]["labels"] == 6
    assert done["scores"]["end"]["recall"] == 1.0
    assert done["scores"]["end"]["precision"] == 1.0
    assert done["scores"]["end"]["spread_px"] < 0.1
    assert done["scores"]["end"]["rms_px"] < 0.1
    assert done["scores"]["1"]["found"] == 0, "nothing can be decided within a period"


def test_a_label_counts_only_while_its_mark_holds(tmp_path):
    path = write(tmp_path / "x.mcap", film(4.0, until=2.0))
    save_tags([Tag(u, v, until=2.0) for u, v in LIGHTS], tags_path(path))
    scores = {math.inf: Score()}
    judge_clips(open_tagged(path), lambda one: make_detector("robotd", {}, one.taken), scores, clip_s=2.0)
    assert (scores[math.inf].clips, scores[math.inf].labels, scores[math.inf].found) == (2, 3, 3)
    scores = {math.inf: Score()}
    judge_clips(open_tagged(path), lambda one: make_detector("robotd", {}, one.taken), scores)
    assert (scores[math.inf].labels, scores[math.inf].false, scores[math.inf].ignored) == (0, 0, 3)


def test_footage_without_marks_is_not_scored(tmp_path, capsys):
    path = write(tmp_path / "x.mcap", film(0.5))
    assert "has no marks (x.mcap.tags.toml)" in refused(capsys, "score", path)


# ---- detectors -------------------------------------------------------------------------------------------------------


def test_both_detectors_run_on_any_footage_with_any_settings(capsys, shelf):
    ours = bench(capsys, "run", shelf)["results"][0]
    assert ours["settings"]["gamma"] == 1.0, "as the recording says"
    assert len(ours["flashes"]) == 3
    assert (ours["missed"], ours["false"]) == ([], [])
    assert [event["appears"] for event in ours["events"]][:3] == [True, True, True]
    assert all(event["t"] < 3.0 for event in ours["events"][:3])
    strict = bench(capsys, "run", shelf, "--set", "false_alarms_per_hour=1e-6", "--set", "gamma=2.2")["results"][0]
    assert (strict["settings"]["false_alarms_per_hour"], strict["settings"]["gamma"]) == (1e-6, 2.2)
    thesis = bench(capsys, "run", shelf, "--detector", "thesis", "--set", "threshold=1")["results"][0]
    assert {(round(f["u"] / 4), round(f["v"] / 4)) for f in thesis["flashes"]} & {(8, 5), (18, 13), (25, 6)}


def test_every_wrong_setting_is_named(tmp_path, capsys, shelf):
    text = refused(capsys, "run", shelf, "--set", "min_margn=3", "--set", "window_s=99")
    assert "did you mean 'min_margin'" in text
    assert "window_s: found 99; expected 1 to 30" in text
    assert "expected one of robotd, thesis" in refused(capsys, "run", shelf, "--detector", "best")
    assert "expected KEY=VALUE" in refused(capsys, "run", shelf, "--set", "3")
    (tmp_path / "s.toml").write_text("min_margin = 1.5\nwindow_s = 2.0\n")
    assert read_settings(["window_s=3.0"], tmp_path / "s.toml") == {"min_margin": 1.5, "window_s": 3.0}


def test_what_a_recording_says_of_itself_becomes_settings():
    mode = {"size": [640, 480], "fps": 30.0, "exposure": 0.0083, "gain": None, "mains_hz": 60.0}
    pattern = {"period": 1.2, "on": [[0.0, 0.03], [0.2, 0.23]]}
    about = {"gamma": "1.8", "row_time_s": "6e-05", "pattern": json.dumps(pattern), "robot": "r"}
    taken = recorded_settings(about, {"mode": json.dumps(mode)})
    config = make_detector("robotd", {"gamma": 2.0}, taken).settings
    assert (config.exposure_s, config.row_time_s, config.gamma) == (0.0083, 6e-5, 2.0)
    assert config.pattern == FlashPattern(1.2, ((0.0, 0.03), (0.2, 0.23)))
    assert make_detector("thesis", {}, taken).settings.pattern.period == 1.2


@pytest.mark.parametrize("name", ["robotd", "thesis"])
def test_an_explanation_knows_every_flash_and_a_reason_for_what_is_none(shelf, name):
    tagged = open_tagged(shelf)
    detector = make_detector(name, {"threshold": 1} if name == "thesis" else {}, tagged.taken)
    triggers = 0
    for step in steps(tagged, detector):
        if name == "thesis" and step.number % 7 and step.number < 119:
            continue
        explained = detector.explain()
        triggers += len(explained.triggers)
        assert explained.change.shape == SIZE[::-1]
    found = [cluster for cluster in explained.clusters if cluster.state == "found"]
    assert triggers > 0
    assert len(found) == len(detector.flashes()) > 0
    for cluster in found:
        assert cluster.score >= explained.threshold
    assert all(cluster.note for cluster in explained.clusters)


def test_a_trace_follows_the_light_and_the_pattern_lies_on_its_flashes(shelf):
    tagged = open_tagged(shelf)
    detector, trace = make_detector("robotd", {}, tagged.taken), Trace(*LIGHTS[0])
    for step in steps(tagged, detector):
        trace.add_frame(step.shot.image, step.shot.t)
        if step.decided:
            trace.add_score(detector.explain(), step.shot.t)
    trace.add_pattern(detector.flashes(), detector.settings.pattern)
    light, times = np.array(trace.light), np.array(trace.times)
    lit = np.zeros(len(times), bool)
    for begin, end in trace.pattern:
        lit |= (times > begin) & (times + 0.010 < end)
    assert light[lit].min() > 15.0
    assert np.median(light[~lit]) < 5.0
    assert np.nanmax(trace.scores) > trace.thresholds[-1]
    late = trace.since(3.0)
    assert late.times[0] >= 3.0
    assert len(late.scores) == len(late.score_times) < len(trace.scores)


@pytest.mark.parametrize("name", ["robotd", "thesis"])
def test_what_is_measured_at_labels_is_set_beside_the_rest(tmp_path, capsys, shelf, name):
    done = bench(capsys, "compare", shelf, "--detector", name, "--until", "2.5", "--picture", tmp_path / "x.png")
    measured = done["measured"]
    assert set(measured) == ({"alternation", "score", "margin"} if name == "robotd" else {"area", "length", "change"})
    assert measured["score" if name == "robotd" else "area"]["on_labels"]["n"] >= 3
    if name == "robotd":
        assert measured["score"]["on_labels"]["5%"] > 10.0
    assert cv2.imread(str(tmp_path / "x.png")).shape == (780, 1000, 3)


# ---- pictures and playing --------------------------------------------------------------------------------------------


def test_colours_tell_found_missed_false_and_ignored_apart():
    gray = np.full((80, 128), 90, np.uint8)
    marks = [Tag(20.0, 20.0), Tag(60.0, 20.0), Tag(100.0, 60.0, "ignore", radius=5.0)]
    picture = overlay(gray, Seen(marks, at((20.2, 20.1), (30.0, 60.0), (101.0, 60.0))))

    def shows(colour, window):
        """Whether a colour is there, but for the softening of lines."""
        return np.abs(window.reshape(-1, 3).astype(int) - colour).max(axis=1).min() < 12

    def near(u, v):
        return picture[max(0, 2 * v - 12) : 2 * v + 14, max(0, 2 * u - 12) : 2 * u + 14]

    assert shows(GREEN, near(20, 20))
    assert shows(SKY, near(20, 20))
    assert shows(YELLOW, near(60, 20))
    assert shows(RED, near(30, 60))
    assert shows(GREY, near(100, 60))
    assert not shows(RED, near(20, 20))
    untouched = overlay(gray, Seen(marks))
    assert not shows(YELLOW, untouched), "no detector was asked"


def test_a_plot_of_nothing_says_so_and_one_of_a_single_value_is_drawn():
    assert plot((300, 120), "x", [], [([], (255, 255, 255), "")]).shape == (120, 300, 3)
    assert plot((300, 120), "x", [1.0], [([2.0], (255, 255, 255), "a")], dots=True).max() == 255
    assert plot((300, 120), "x", [1.0, 2.0], [([math.nan] * 2, (255, 255, 255), "a")]).shape == (120, 300, 3)


@pytest.mark.parametrize("detector", ["robotd", "thesis"])
def test_the_reaction_to_a_frame_and_the_course_of_a_place_are_drawn(tmp_path, capsys, shelf, detector):
    done = bench(
        capsys, "show", shelf, "--detector", detector, "--frame", "75", "--mark", "2", "-o", tmp_path / "x.png"
    )
    assert done["frame"] == 75
    assert len(done["trace"]["times"]) == 76
    picture = cv2.imread(str(tmp_path / "x.png"))
    assert picture.shape[1] > 2000
    assert picture.std() > 20
    assert "no mark 9; there are 3" in refused(capsys, "show", shelf, "--mark", "9", "-o", tmp_path / "y.png")
    late = refused(capsys, "show", shelf, "--at", "99", "-o", tmp_path / "y.png")
    assert "--at 99: " in late
    assert "ends at " in late


def test_playing_keeps_the_pace_of_the_footage(shelf):
    shown = []

    async def main():
        begun = now()
        player = Player(open_tagged(shelf), lambda: None, lambda *frame: shown.append((now() - begun, *frame)))
        count = await player.play(1.0, 2.0, 0.5)
        return count, now() - begun

    count, took = run_virtual(main())
    assert count == 31
    assert took == pytest.approx(2.0, abs=0.01)
    assert all(when == pytest.approx(2.0 * (shot.t - 1.0), abs=0.001) for when, _, shot, _ in shown)


def test_stepping_goes_on_back_to_a_number_and_ends(tmp_path, shelf):
    shown = []
    player = Player(
        open_tagged(shelf),
        lambda: make_detector("robotd", {"gamma": 1.0}),
        lambda number, shot, seen: shown.append(number),
        tmp_path / "view.png",
    )
    player.step(io.StringIO("\n\nb\n100\n3\nq\n"), 0.0, math.inf)
    assert shown == [0, 1, 2, 1, 100, 3]
    assert cv2.imread(str(tmp_path / "view.png")).shape[1] == 2 * SIZE[0]


def test_a_video_shows_every_frame(tmp_path, capsys, shelf):
    done = bench(
        capsys, "play", shelf, "--detector", "robotd", "--from", "1", "--until", "2", "--video", tmp_path / "x.avi"
    )
    capture = cv2.VideoCapture(str(tmp_path / "x.avi"))
    assert round(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == done["frames"] == 31
    capture.release()
    assert "ends in .avi" in refused(capsys, "play", shelf, "--video", tmp_path / "x.mov")


# ---- tuning ----------------------------------------------------------------------------------------------------------


def test_ranges():
    import random

    rng = random.Random(1)
    whole, log, some = parse_range("max_candidates=10:90"), parse_range("f=1e-3:10:log"), parse_range("x=1,2.5,true")
    assert some.choices == (1, 2.5, True)
    for _ in range(200):
        assert 10 <= (k := whole.draw(rng)) <= 90
        assert isinstance(whole.near(k, rng), int)
        assert 1e-3 <= log.near(log.draw(rng), rng) <= 10.0
    drawn = [log.draw(rng) for _ in range(400)]
    assert 0.4 < np.mean(np.array(drawn) < 0.1) < 0.6, "even in the logarithm"
    for text in ("x", "x=2:1", "x=0:1:log", "x=1:2:lin", "x=a", "3=1:2"):
        with pytest.raises(InputError, match="expected NAME=LOW:HIGH"):
            parse_range(text)


def test_tuning_finds_what_is_better_and_other_footage_judges_it(tmp_path, capsys, shelf):
    other = write(tmp_path / "other.mcap", film(seed=5))
    save_tags([Tag(u, v) for u, v in LIGHTS], tags_path(other))
    spoilt = ("--set", "max_width_px=0.6")
    before = bench(capsys, "score", shelf, *spoilt)["scores"]["end"]["recall"]
    assert before < 1.0
    done = bench(
        *(capsys, "tune", shelf, *spoilt, "--param", "max_width_px=0.5:3.0", "--trials", "6", "--seed", "3"),
        *("--report", other, "-o", tmp_path / "best.toml"),
    )
    assert done["tuned_on"]["before"]["recall"] == before
    assert done["tuned_on"]["after"]["recall"] == 1.0
    assert "too good" in done["tuned_on"]["note"]
    assert done["reported_on"]["after"]["recall"] == 1.0
    assert done["reported_on"]["footage"] == [f"{other}:front"]
    assert done["settings"]["max_width_px"] > 1.0
    again = bench(capsys, "score", other, "--settings", tmp_path / "best.toml")
    assert again["scores"]["end"]["recall"] == 1.0


def test_the_set_that_was_tuned_on_is_never_the_judge(tmp_path, capsys, shelf):
    copy = tmp_path / "another name.mcap"
    copy.write_bytes(shelf.read_bytes())
    save_tags([], tags_path(copy))
    text = refused(capsys, "tune", shelf, "--param", "min_margin=1:9", "--report", copy)
    assert "another name.mcap: is in the tuning set, too" in text
    code = main(["workbench", "tune", str(shelf), "--param", "min_margin=1:9", "--trials", "1"])
    printed = capsys.readouterr().out
    assert code == 0
    assert "too good to be quoted" in printed
    assert "how good they are elsewhere is not known" in printed
    assert "no marked label" in refused(capsys, "tune", copy, "--param", "min_margin=1:9")


def test_the_same_seed_tries_the_same_and_the_best_comes_first(monkeypatch):
    def pretend(tagged, detector, settings, clip_s):
        """Finds the label at a gain above 3, and something false besides above 6."""
        gain = settings.get("gain", 0.0)
        labels = [Tag(10.0, 10.0)]
        score = Score()
        score.add(at(*[(10.0, 10.0)] * (gain > 3.0), *[(50.0, 50.0)] * (gain > 6.0)), labels)
        return score

    monkeypatch.setattr("robotd.workbench.tune.score_set", pretend)

    @dataclass
    class One:
        tags = (Tag(10.0, 10.0),)

    ranges = [Range("gain", 0.0, 10.0)]
    first, again = (tune([One()], "x", {}, ranges, trials=12, seed=4) for _ in range(2))
    assert [trial.settings for trial in first] == [trial.settings for trial in again]
    assert 3.0 < first[0].settings["gain"] <= 6.0
    values = [trial.value for trial in first]
    assert values == sorted(values, reverse=True)
    assert objective(pretend([], "", {"gain": 8.0}, None), 0.9) < objective(pretend([], "", {"gain": 4.0}, None), 0.9)


# ---- files -----------------------------------------------------------------------------------------------------------


def test_what_is_in_footage_is_told(tmp_path, capsys, shelf):
    entry = bench(capsys, "info", shelf)["footage"][0]
    assert (entry["frames"], entry["size"], entry["fps"], entry["tags"]["label"]) == (120, [128, 80], 30.0, 3)
    assert (entry["whole"], entry["camera"], entry["about"]["gamma"]) == (True, "front", "1.0")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(shelf.read_bytes()[:300_000])
    assert not bench(capsys, "info", cut)["footage"][0]["whole"]
    done = bench(capsys, "recover", cut, "-o", tmp_path / "whole.mcap")
    assert read_contents(tmp_path / "whole.mcap").frames == done["frames"]


def test_every_camera_of_a_recording_is_opened_and_every_wrong_file_named(tmp_path, shelf):
    both = tmp_path / "both.mcap"
    with FrameRecorder(both) as recorder:
        for frame in film(0.2):
            for camera in ("front", "left"):
                recorder.frame(Frame(camera, frame.t, frame.image, frame.sequence), frame.t)
    save_tags([Tag(1.0, 1.0, camera="left"), Tag(2.0, 2.0)], tags_path(both))
    opened = open_all([both, shelf])
    assert [one.name for one in opened] == [f"{both}:front", f"{both}:left", f"{shelf}:front"]
    assert [len(one.tags) for one in opened] == [1, 2, 3]
    with pytest.raises(InputError, match="say which camera"):
        open_tagged(both)
    with pytest.raises(InputError) as caught:
        open_all([tmp_path / "a.mcap", tmp_path / "b.avi"])
    assert len(caught.value.problems) == 2


def test_frames_become_pictures_with_their_times_and_can_be_opened_again(tmp_path, capsys, shelf):
    done = bench(capsys, "export", shelf, "-o", tmp_path / "png", "--format", "png", "--from", "1", "--until", "2")
    assert done["frames"] == 31
    again = open_tagged(tmp_path / "png")
    frames = [frame.image for frame in read_frames(shelf)][30:61]
    for (_, shot), image in zip(again.frames(), frames, strict=True):
        assert np.array_equal(shot.image, image)
    assert "is not an empty folder" in refused(capsys, "export", shelf, "-o", tmp_path / "png")
    assert bench(capsys, "export", shelf, "-o", tmp_path / "few", "--sharp", "5")["frames"] == 5
    assert "has no frame from 90 to 99 s" in refused(
        capsys, "export", shelf, "-o", tmp_path / "none", "--from", "90", "--until", "99"
    )
    assert not (tmp_path / "none").exists()


def test_jpegs_of_a_recording_are_exported_as_the_camera_made_them(tmp_path, capsys):
    path = write(tmp_path / "x.mcap", film(0.2), jpeg=True)
    files = bench(capsys, "export", path, "-o", tmp_path / "jpg")["files"]
    encoded = [frame.encoded for frame in read_frames(path)]
    from pathlib import Path

    assert [Path(file).read_bytes() for file in files] == encoded


def test_a_part_of_footage_becomes_a_recording_with_its_marks(tmp_path, capsys, shelf):
    save_tags([Tag(5.0, 5.0, until=0.5), Tag(6.0, 16.0, since=1.5, until=3.0)], tags_path(shelf.with_name("y.mcap")))
    source = shelf.with_name("y.mcap")
    source.write_bytes(shelf.read_bytes())
    out = tmp_path / "part.mcap"
    done = bench(capsys, "export", source, "-o", out, "--from", "1", "--every", "2")
    assert done["frames"] == read_contents(out).frames["front"] == 45
    assert read_contents(out).about["gamma"] == "1.0"
    (tag,) = load_tags(tags_path(out))
    assert (tag.u, round(tag.since, 6), round(tag.until, 6)) == (6.0, 0.5, 2.0)
    assert "exists; name a new file" in refused(capsys, "export", source, "-o", out)
