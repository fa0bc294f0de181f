"""`robotd calibrate odometry`, from a person with a tape measure over the robot's bytes to the calibration file."""

import asyncio
import dataclasses
import math
import os
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.__main__ import main
from robotd.bind import bind
from robotd.calibrate import Terminal, calibrate_odometry
from robotd.clock import run_virtual
from robotd.config import Calibration, Wheels, load_calibration, save_calibration, save_wheels
from robotd.errors import ConfigError, DriverFault, InputError, MissionError
from robotd.records import CameraModel, Pose, Transform
from robotd.sim.body import Body
from robotd.sim.roomba import SimRoomba
from robotd.sim.roomba_link import RoombaLink
from robotd.sim.settings import WorldSettings
from robotd.sim.stores import LineLayout, StoreLayout
from robotd.toml_edit import assignments, replace_table
from robotd.wheel_calibration import KINDS, Run, calibrate, implausible, predict
from robotd.wheel_runs import RunPlan

HALL = StoreLayout(
    format="robotd-store/1",
    name="hall",
    size=(1000.0, 1000.0),
    line=LineLayout(((1.0, 1.0), (2.0, 1.0)), (0.0, 1.0)),
    disturbances=False,
)
MIDDLE = Pose(500.0, 500.0, 0.3)
QUIET = WorldSettings(travel_noise=0.0, slip_distance=0.0, wheel_scale_error=0.0, wheel_base_error=0.0, tilt=0.0)
NOISY = WorldSettings(slip_distance=0.0, wheel_scale_error=0.0, wheel_base_error=0.0, tilt=0.0)
LEFT, RIGHT, BASE = 0.991, 1.004, 0.2374  # about 1 % off
CONFIG = """
[robot]
calibration = "calibration.toml"
[drivers.base]
driver = "roomba"
port = "/dev/robotd/base"
[drivers.eye]
driver = "v4l2"
device = "/dev/video0"
[drivers.labels]
driver = "pricer"
host = "127.0.0.1"
port = 4444
[drivers.follower]
driver = "line_follower"
camera = "eye"
"""


class Uneven(Body):
    """A body whose wheels differ."""

    left, right, base = LEFT, RIGHT, BASE

    def __init__(self, layout, settings, rng, start):
        super().__init__(layout, dataclasses.replace(settings, wheel_base=self.base), rng, start)

    def _roll(self, wheel, rotation):
        return super()._roll(wheel, rotation) * (self.left, self.right)[wheel]


class Bench:
    """A simulated robot on the floor; the Hardware of its driver."""

    pins = None

    def __init__(self, world=QUIET, seed=1, layout=HALL, start=MIDDLE):
        self.body = Uneven(layout, world, np.random.default_rng(seed), start)
        self.robot = SimRoomba(self.body, np.random.default_rng([seed, 1]))
        self.link = None

    async def open_serial(self, port, baud):
        self.link = RoombaLink(self.robot, baud)
        return self.link

    @property
    def is_moving(self):
        return self.robot.left.speed != 0.0 or self.robot.right.speed != 0.0


class Surveyor:
    """A person with a tape measure: 2 mm, 1 degree by eye, and 5 mrad in laying the robot along the strip."""

    def __init__(self, bench, seed=1, length=0.002, angle=0.0175, alignment=0.005):
        self.bench, self.rng = bench, np.random.default_rng([seed, 2])
        self.sigmas = length, angle, alignment
        self.said, self.kinds, self.asked = [], [], 0
        self.slips = {}  # number of a question: what is answered instead

    async def tell(self, text):
        self.said.append(text)

    async def ready(self, text):
        self.kinds.append(max((kind for kind in KINDS if f": {kind}." in text), key=len))
        self.start = self.bench.body.pose
        self.strip = self.start.heading + self.rng.normal(0.0, self.sigmas[2])
        await asyncio.sleep(3.0)

    async def measure(self, text):
        await asyncio.sleep(3.0)
        assert not self.bench.is_moving
        self.asked += 1
        if self.asked in self.slips:
            return self.slips[self.asked]
        pose, start, (length, angle, _) = self.bench.body.pose, self.start, self.sigmas
        if "degrees" in text:
            return math.degrees(math.remainder(pose.heading - start.heading, 2 * math.pi) + self.rng.normal(0.0, angle))
        front = -0.17 if self.kinds[-1].startswith("out") else 0.17
        dx = pose.x + front * math.cos(pose.heading) - start.x - 0.17 * math.cos(start.heading)
        dy = pose.y + front * math.sin(pose.heading) - start.y - 0.17 * math.sin(start.heading)
        c, s = math.cos(self.strip), math.sin(self.strip)
        along, beside = c * dx + s * dy, c * dy - s * dx
        value = beside if "beside" in text else along
        if self.kinds[-1] == "backward" and value is along:
            value = abs(value)
        return 1e3 * (value + self.rng.normal(0.0, length))


def write_config(folder):
    (folder / "robotd.toml").write_text(CONFIG)
    return folder / "robotd.toml"


def calibrated(tmp_path, bench=None, person=None, plan=None):
    """Run the whole command in virtual time; returns its wheels and the person."""
    bench = bench or Bench()
    person = person or Surveyor(bench)

    async def main():
        return await calibrate_odometry(write_config(tmp_path), plan or RunPlan(), bench, person)

    return run_virtual(main()), person


# ---- the estimator ---------------------------------------------------------------------------------------------------

TRUE = Wheels(scale_left=LEFT, scale_right=RIGHT, base=BASE)
ROUGH = np.linspace(0.0, 1.0, 11)[1:, None]


def driven(kind, distance=2.0, turns=5):
    """(N, 2) wheel travel of a run that nominal wheels would drive exactly."""
    rim = 0.5 * 0.235 * np.array([-1.0, 1.0])
    straight, spin = ROUGH * distance * np.ones(2), ROUGH * 2 * math.pi * turns * rim
    half = ROUGH * math.pi * (0.7 * 0.235 + rim)
    if kind in KINDS[:2]:
        return straight if kind == "forward" else -straight
    if kind in KINDS[2:4]:
        return spin if kind == "counter-clockwise" else -spin
    legs = [straight, half if kind.endswith("left") else half[:, ::-1], straight]
    return np.concatenate([leg + sum(before[-1] for before in legs[:k]) for k, leg in enumerate(legs)])


def measured(kind, true=TRUE, rng=None, distance=2.0):
    """A run as it would be measured, with the errors of wheels and tape if there is an `rng`."""
    travel = driven(kind, distance)
    sideways = 0.002 if kind.startswith("out") else math.hypot(0.002, 0.005 * distance)
    reach = (0.17, -0.17) if kind.startswith("out") else (0.17, 0.17)
    run = Run(kind, travel, (0.0, 0.0), (0.002, sideways), reach=reach)
    if kind in KINDS[2:4]:
        run = Run(kind, travel, turn=0.0)
    rolled = travel
    if rng is not None:
        steps = np.diff(travel, axis=0, prepend=0.0)
        sigma = true.travel_noise * np.sqrt(np.abs(steps)) / (true.scale_left, true.scale_right)
        rolled = np.cumsum(steps + sigma * rng.standard_normal(steps.shape), axis=0)
    value = predict(dataclasses.replace(run, travel=rolled), true.scale_left, true.scale_right, true.base)
    if rng is not None:
        value = value + rng.standard_normal(len(value)) * (run.turn_sigma if run.turn is not None else run.offset_sigma)
    if run.turn is not None:
        return dataclasses.replace(run, turn=float(value[0]))
    return dataclasses.replace(run, offset=(float(value[0]), float(value[1])))


@settings(deadline=None, max_examples=25)
@given(left=st.floats(0.98, 1.02), right=st.floats(0.98, 1.02), base=st.floats(0.228, 0.242))
def test_exact_measurements_give_the_wheels_exactly(left, right, base):
    true = Wheels(scale_left=left, scale_right=right, base=base)
    found = calibrate([measured(kind, true) for kind in KINDS], Wheels()).wheels
    assert (found.scale_left, found.scale_right) == pytest.approx((left, right), abs=1e-7)
    assert found.base == pytest.approx(base, abs=1e-7)


def test_a_straight_run_ends_on_its_arc_and_out_and_back_on_the_mark():
    assert predict(measured("forward"), 1.0, 1.0, 0.235) == pytest.approx([2.0, 0.0])
    bent = predict(Run("forward", driven("forward"), (0.0, 0.0)), 0.99, 1.01, 0.235)
    turn = 2.0 * 0.02 / 0.235
    assert bent == pytest.approx([2.0 / turn * math.sin(turn), 2.0 / turn * (1 - math.cos(turn))])
    for kind, width in zip(KINDS[4:], (1.4 * 0.235, -1.4 * 0.235), strict=True):
        assert predict(measured(kind), 1.0, 1.0, 0.235) == pytest.approx([0.0, width], abs=1e-9)
    left, right = (predict(measured(kind), 0.9999, 1.0001, 0.235)[1] for kind in KINDS[4:])
    left, right = left - 1.4 * 0.235, right + 1.4 * 0.235
    assert left == pytest.approx(right, rel=0.1)  # the bends add up, whichever way it turned
    bend = 0.0002 / 0.235  # a metre; the robot's back is 0.17 m from the axle and turned by all bends
    half = 0.7 * 0.235 * math.pi
    assert 0.5 * (left + right) == pytest.approx(bend * (-2.0 * (2.0 + half) + 0.17 * (4.0 + half)), rel=0.02)


def test_errors_of_the_result_are_as_large_as_its_covariance_says():
    """NEES / 3 over 50 calibrations with noise of wheels and tape: chi-square, four standard deviations."""
    rng, squares, refused = np.random.default_rng(4), [], 0
    for _ in range(50):
        try:
            wheels = calibrate([measured(kind, rng=rng) for kind in KINDS * 2], Wheels()).wheels
        except InputError:
            refused += 1
            continue
        error = np.array([wheels.scale_left - LEFT, wheels.scale_right - RIGHT, wheels.base - BASE])
        squares.append(error @ np.linalg.solve(np.array(wheels.covariance), error) / 3.0)
    assert refused <= 2  # 600 runs, of which one in 10000 disagrees by chance
    assert np.mean(squares) < 1.0 + 4.0 * math.sqrt(2.0 / 3.0 / 50)
    assert np.mean(squares) > 0.6  # the covariance is widened where the runs scatter by more than expected


def test_everything_that_is_missing_is_named_at_once():
    with pytest.raises(InputError) as caught:
        calibrate([measured("forward"), measured("clockwise"), measured("out and back, turning left")], Wheels())
    text = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 3
    assert "no run backward; need at least one of each" in text
    assert "no run counter-clockwise" in text
    assert "no run out and back, turning right" in text


@pytest.mark.parametrize(
    ("offset", "words"),
    [((0.00198, 0.0), "typed in metres"), ((0.198, 0.0), "typed in centimetres"), ((0.0786, 0.0), "typed in inches"),
     ((1.7, 0.0), "the right mark"), ((2.0, 0.8), "aligned with the tape")],
)  # fmt: skip
def test_a_measurement_that_cannot_be_is_refused_with_the_likely_reason(offset, words):
    runs = [measured(kind) for kind in KINDS]
    assert not any(implausible(run, Wheels()) for run in runs)
    runs[0] = dataclasses.replace(runs[0], offset=offset)
    with pytest.raises(InputError, match=rf"run 1 \(forward\): .*{words}"):
        calibrate(runs, Wheels())


def test_turns_with_the_wrong_sign_or_count_are_refused():
    runs = [measured(kind) for kind in KINDS]
    runs[3] = dataclasses.replace(runs[3], turn=-runs[3].turn)
    with pytest.raises(InputError, match=r"run 4 \(clockwise\): .*is the sign right"):
        calibrate(runs, Wheels())


@pytest.mark.parametrize("which", [1, 3, 5, 8])
def test_a_run_in_which_something_happened_is_named(which):
    rng = np.random.default_rng(which)
    runs = [measured(kind, rng=rng) for kind in KINDS * 2]
    odd = runs[which]
    if odd.turn is not None:
        runs[which] = dataclasses.replace(odd, turn=odd.turn + math.radians(20.0))
    else:
        runs[which] = dataclasses.replace(odd, offset=(odd.offset[0] + 0.1, odd.offset[1]))
    with pytest.raises(InputError, match=rf"run {which + 1} \({odd.kind}\) disagrees with the others"):
        calibrate(runs, Wheels())


def test_runs_that_scatter_all_over_are_refused():
    rng = np.random.default_rng(3)
    runs = []
    for kind in KINDS * 3:
        run = measured(kind)
        if run.turn is None:
            runs.append(dataclasses.replace(run, offset=(run.offset[0] + rng.choice([-0.01, 0.01]), run.offset[1])))
        else:
            runs.append(dataclasses.replace(run, turn=run.turn + rng.choice([-0.1, 0.1])))
    with pytest.raises(InputError, match=r"scatter \d|disagrees"):
        calibrate(runs, Wheels(travel_noise=0.0003))


# ---- the file --------------------------------------------------------------------------------------------------------

FILE = """\
# calibrated in spring
gamma = 2.1   # of the cameras

[wheels]  # measured by hand
base = 0.2361 # with a calliper
travel_noise = 0.002
covariance = [
  [1e-6, 0.0, 0.0],  # left
  [0.0, 1e-6, 0.0],
  [0.0, 0.0, 1e-8],
]
# the next one is from the parts list
scale_left = 1.01

[priors]
tilt_rad = 0.004 # [wheels]
"""


def test_only_the_wheels_change_in_the_calibration_file(tmp_path):
    path = tmp_path / "calibration.toml"
    path.write_text(FILE)
    path.chmod(0o640)
    wheels = Wheels(0.99, 1.02, 0.2345, 0.002, ((2e-6, 1e-7, 0.0), (1e-7, 2e-6, 0.0), (0.0, 0.0, 3e-8)))
    save_wheels(wheels, path)
    assert load_calibration(path) == dataclasses.replace(bind(Calibration, tomllib.loads(FILE), ""), wheels=wheels)
    text = path.read_text()
    kept = ("# calibrated in spring", "gamma = 2.1   # of the cameras", "[wheels]  # measured by hand")
    kept += ("# with a calliper", "# the next one is from the parts list", "tilt_rad = 0.004 # [wheels]")
    assert [words for words in kept if words not in text] == []
    assert text.index("base") < text.index("scale_left") < text.index("scale_right") < text.index("[priors]")
    assert path.stat().st_mode & 0o777 == 0o640
    assert [entry.name for entry in tmp_path.iterdir()] == ["calibration.toml"]


def test_a_calibration_file_is_made_if_there_is_none_and_links_stay_links(tmp_path):
    target, link = tmp_path / "real.toml", tmp_path / "calibration.toml"
    link.symlink_to(target)
    save_wheels(TRUE, link)
    assert link.is_symlink()
    assert load_calibration(link) == Calibration(wheels=TRUE)


def test_cameras_survive_to_the_last_bit(tmp_path):
    camera = CameraModel("front", (640, 480), (268.5, 1e-13, 1 / 3, 239.5), Transform((0.1, -1 / 3, 0), (0, 0, 0.5)))
    before = Calibration(cameras=(camera, dataclasses.replace(camera, name="rear")), beacons={"front": (0.1, 0, 0.6)})
    save_calibration(before, tmp_path / "c.toml")
    save_wheels(TRUE, tmp_path / "c.toml")
    assert load_calibration(tmp_path / "c.toml") == dataclasses.replace(before, wheels=TRUE)


@pytest.mark.parametrize("text", ["wheels = { base = 0.24 }\n", "wheels.base = 0.24\n"])
def test_wheels_that_are_no_section_are_refused_and_left_alone(text, tmp_path):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"write it as a section \[wheels\]"):
        save_wheels(TRUE, tmp_path / "c.toml")
    assert (tmp_path / "c.toml").read_text() == text


names = st.text("abc_", min_size=1, max_size=3)
scalars = st.one_of(st.integers(-9, 9), st.booleans(), st.text('a #[]"\n=', max_size=6), st.lists(st.integers(0, 9)))


@settings(deadline=None, max_examples=60)
@given(tables=st.dictionaries(names | st.just("wheels"), st.dictionaries(names, scalars, max_size=4), max_size=4),
       values=st.dictionaries(names, scalars, min_size=1, max_size=3))  # fmt: skip
def test_setting_keys_of_one_table_changes_nothing_else(tables, values):
    def spelled(value):
        if isinstance(value, str):
            return '"' + value.replace('"', '\\"').replace("\n", "\\n") + '"'
        return str(value).lower()

    text = "".join(
        f"# {name}\n[{name}]\n" + "".join(f"{key} = {spelled(value)} # x\n" for key, value in table.items())
        for name, table in tables.items()
    )
    changed = replace_table(text, "wheels", {key: spelled(value) for key, value in values.items()}, "f.toml")
    assert tomllib.loads(changed) == {**tables, "wheels": {**tables.get("wheels", {}), **values}}
    assert changed.count("# ") >= text.count("# ")


def test_assignments_of_a_record_read_back_as_the_record():
    text = "\n".join(f"{key} = {value}" for key, value in assignments(TRUE).items())
    assert bind(Wheels, tomllib.loads(text), "") == TRUE


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The whole command on a robot whose wheels are about 1 % off, with one number mistyped by 60 mm."""
    folder = tmp_path_factory.mktemp("calibrate")
    (folder / "calibration.toml").write_text("# mine\n[wheels]\nslip_distance = 30.0 # waxed floor\n")
    bench = Bench(NOISY, 3)
    person = Surveyor(bench, 3)
    person.slips[1] = 1440.0
    wheels, _ = calibrated(folder, bench, person, RunPlan(distance=1.5, turns=2, repeat=1))
    return folder, wheels, person, bench


def test_the_command_finds_the_wheels_within_what_it_states(done):
    _, wheels, _, _ = done
    error = np.array([wheels.scale_left - LEFT, wheels.scale_right - RIGHT, wheels.base - BASE])
    assert error @ np.linalg.solve(np.array(wheels.covariance), error) < 16.3  # chi-square, 3 degrees, 99.9 %
    assert math.sqrt(wheels.covariance[0][0]) < 0.004
    assert math.sqrt(wheels.covariance[2][2]) < 0.0015


def test_the_command_writes_the_wheels_and_nothing_else(done):
    folder, wheels, _, bench = done
    text = (folder / "calibration.toml").read_text()
    assert load_calibration(folder / "calibration.toml") == Calibration(wheels=wheels)
    assert text.startswith("# mine\n[wheels]\nslip_distance = 30.0 # waxed floor\n")
    assert bench.robot.left.target == bench.robot.right.target == 0.0


def test_the_command_has_a_run_with_a_mistyped_number_driven_again_and_shows_old_and_new(done):
    _, _, person, _ = done
    assert person.kinds[:6] == list(KINDS)
    assert "forward" in person.kinds[6:]
    assert any("does not fit to the others" in text for text in person.said)
    table = next(text for text in person.said if "left wheel" in text)
    assert re.search(r"left wheel +\+0\.0 +-\d+\.\d \+- \d\.\d mm/m", table)
    assert re.search(r"wheel base +235\.0 +23\d\.\d \+- \d\.\d mm \(\+- \d\.\d degrees a turn\)", table)
    assert "written to" in person.said[-1]


def interrupted(tmp_path, trouble, layout=HALL, yes_man=None):
    """Start the command, let `trouble(bench)` happen in the first run; returns what it raised and the bench."""
    bench = Bench(layout=layout)
    person = yes_man(bench) if yes_man else Surveyor(bench)
    (tmp_path / "calibration.toml").write_text(FILE)

    async def main():
        work = asyncio.create_task(calibrate_odometry(write_config(tmp_path), RunPlan(), bench, person))
        await asyncio.sleep(9.0)
        assert bench.is_moving
        trouble(bench, work)
        with pytest.raises((MissionError, DriverFault, asyncio.CancelledError)) as caught:
            await work
        await asyncio.sleep(1.0)
        return caught.value

    error = run_virtual(main())
    assert (tmp_path / "calibration.toml").read_text() == FILE
    return error, bench


def test_a_hit_bumper_ends_it_and_writes_nothing(tmp_path):
    def bump(bench, work):
        bench.body.bump_left = True

    error, bench = interrupted(tmp_path, bump)
    assert not bench.is_moving
    assert "the robot was stopped: the left bumper is pressed" in str(error)


def test_ctrl_c_halts_and_writes_nothing(tmp_path):
    error, bench = interrupted(tmp_path, lambda bench, work: work.cancel())
    assert isinstance(error, asyncio.CancelledError)
    assert not bench.is_moving
    assert bench.robot.left.target == bench.robot.right.target == 0.0


def test_a_pulled_cable_ends_it_and_writes_nothing(tmp_path):
    error, _ = interrupted(tmp_path, lambda bench, work: bench.link.unplug())
    assert isinstance(error, DriverFault)


def test_a_robot_that_is_held_up_is_waited_for(tmp_path):
    class Lifting(Surveyor):
        async def ready(self, text):
            await super().ready(text)
            if len(self.kinds) == 1:
                self.bench.body.lift()
            else:
                self.bench.body.put_down()
            await asyncio.sleep(0.5)

    people = []

    def make(bench):
        people.append(Lifting(bench))
        return people[0]

    interrupted(tmp_path, lambda bench, work: work.cancel(), yes_man=make)
    assert people[0].kinds[:2] == ["forward", "forward"]
    assert any("cannot start: the left wheel has dropped" in text for text in people[0].said)


def test_an_answer_that_cannot_be_is_asked_for_again(tmp_path):
    class Metric(Surveyor):
        async def measure(self, text):
            value = await super().measure(text)
            if self.asked == 1:
                return value / 1000.0
            if self.asked == 3:
                raise MissionError("enough")
            return value

    bench = Bench()
    person = Metric(bench)
    with pytest.raises(MissionError, match="enough"):
        calibrated(tmp_path, bench, person)
    assert any("typed in metres" in text for text in person.said)
    assert person.kinds == ["forward"]


def test_a_folder_that_cannot_be_written_is_noticed_before_the_robot_moves(tmp_path):
    (tmp_path / "robotd.toml").write_text(CONFIG.replace("calibration.toml", "nowhere/calibration.toml"))
    bench = Bench()
    with pytest.raises(ConfigError, match="there is no folder"):
        run_virtual(calibrate_odometry(tmp_path / "robotd.toml", RunPlan(), bench, Surveyor(bench)))
    assert bench.link is None


# ---- the terminal ----------------------------------------------------------------------------------------------------


def answered(text, questions, *, yes=True):
    """What a terminal makes of typed text: numbers and the error that ended it."""

    async def main():
        ours, theirs = os.pipe()
        os.write(theirs, text.encode())
        os.close(theirs)
        with os.fdopen(ours, encoding="utf-8") as source:
            person = Terminal(source, yes=yes)
            return [await (person.measure("?") if question else person.ready("!")) for question in questions]

    return asyncio.run(main())


def test_numbers_are_read_as_people_type_them(capsys):
    assert answered("# run 1\n1998,5\nten\n-3 # left\n+4.25", [1, 1, 1]) == [1998.5, -3.0, 4.25]
    assert "found 'ten'; expected a number" in capsys.readouterr().out


def test_enter_is_awaited_before_a_run_unless_told_not_to():
    assert answered("\n5\n", [0, 1], yes=False) == [None, 5.0]
    assert answered("5\n", [0, 1], yes=True) == [None, 5.0]


def test_answers_that_end_early_end_the_calibration(tmp_path):
    with pytest.raises(MissionError, match="no more answers; nothing was written"):
        answered("5\n", [1, 1])
    (tmp_path / "answers").write_text("7\n")

    async def main():
        with (tmp_path / "answers").open() as source:
            return await Terminal(source, yes=True).measure("?")

    assert asyncio.run(main()) == 7.0


def test_waiting_for_an_answer_can_be_cancelled():
    async def main():
        ours, theirs = os.pipe()
        with os.fdopen(ours) as source:
            task = asyncio.create_task(Terminal(source, yes=True).measure("?"))
            await asyncio.sleep(0.01)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        os.close(theirs)

    asyncio.run(main())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--distance", "200"], "distance: found 200.0; expected 0.5 to 20"), (["-c", "/nowhere.toml"], "no such file"),
     (["--answers", "/nowhere"], "--answers /nowhere: cannot be read")],
)  # fmt: skip
def test_wrong_arguments_are_named(arguments, words, tmp_path, capsys):
    config = ["-c", str(write_config(tmp_path))] if "-c" not in arguments else []
    assert main(["calibrate", "odometry", *config, *arguments]) == 2
    assert words in capsys.readouterr().err


def test_the_help_names_the_real_defaults():
    plan, text = RunPlan(), (Path(__file__).parents[1] / "robotd" / "__main__.py").read_text()
    for name, words in (("distance", "metres of each straight"), ("turns", "turns of each spin"), ("repeat", "run")):
        assert re.search(rf'"--{name}".*{words} \(default: {getattr(plan, name):g}\)', text)
