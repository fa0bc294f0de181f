"""The simulated label system is as late, lossy and silent as the real one, and its light is exact."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.bind import bind
from robotd.clock import now, run_virtual
from robotd.errors import ConfigError
from robotd.gateway import Outbox
from robotd.sim.labels import BURST, PERIOD_S, LabelSystem, LabelSystemSettings

IDS = [f"A{number}" for number in range(8)]
SURE = LabelSystemSettings(lost_fraction=0.0, clock_error=0.0)
PROMPT = LabelSystemSettings(
    lost_fraction=0.0, clock_error=0.0, delay_median_s=1.0, delay_p95_s=1.0, commands_per_s=1e6
)


def make_system(folder, settings=SURE, ids=IDS, seed=1):
    return LabelSystem(ids, settings, folder, np.random.default_rng(seed))


def command(folder, name, *lines):
    (folder / name).write_text("".join(line + "\n" for line in lines))


def light(system, t0, t1):
    count = len(system._rate)
    return system.lit(np.full(count, t0), np.full(count, t1))


def test_the_folder_is_scanned_every_three_seconds_of_loop_time(tmp_path):
    fetched = []

    class Watched(LabelSystem):
        def scan(self, t):
            fetched.append(t)
            super().scan(t)

    async def main():
        system = Watched(IDS, SURE, tmp_path, np.random.default_rng(1))
        task = asyncio.create_task(system.run())
        await asyncio.sleep(3600.0)
        task.cancel()
        assert now() == 3600.0

    run_virtual(main())
    assert 0.0 <= fetched[0] < 3.0
    np.testing.assert_allclose(np.diff(fetched), 3.0, atol=1e-9)
    assert len(fetched) == 1200


def test_files_are_obeyed_in_the_order_of_their_names_and_deleted(tmp_path):
    command(tmp_path, "robotd-2.txt", "FLASH;A1;3;1.0")
    command(tmp_path, "robotd-1.txt", "FLASH;A0;3;1.0", "FLASH;A2;3;1.0")
    system = make_system(tmp_path, PROMPT)
    system.settings = LabelSystemSettings(delay_median_s=1.0, delay_p95_s=1.0, lost_fraction=0.0, commands_per_s=10.0)
    system.scan(10.0)
    assert list(tmp_path.iterdir()) == []
    on = [light(system, t, t + 1e-9) for t in (11.05, 11.15, 11.25)]
    starts = [flashes[0].start for flashes in system._flashes if flashes]
    np.testing.assert_allclose(starts, [11.0, 11.2, 11.1])  # ten commands a second: A0, A2, A1
    assert on[0][0] == pytest.approx(1.0)
    assert on[0][1] == on[0][2] == 0.0


def test_without_any_feedback_files_stay_and_each_is_obeyed_once(tmp_path):
    silent = LabelSystemSettings(lost_fraction=0.0, clock_error=0.0, feedback=False)
    command(tmp_path, "robotd-1.txt", "FLASH;A0;3;1.0")
    (tmp_path / "robotd-2.txt").write_text("FLASH;A1;3")  # half written
    system = make_system(tmp_path, silent)
    system.scan(10.0)
    command(tmp_path, "robotd-2.txt", "FLASH;A1;3;1.0", "FLASH;A2;3;1.0")
    for t in (13.0, 16.0):
        system.scan(t)
    assert system.commands == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["robotd-1.txt", "robotd-2.txt"]
    (tmp_path / "robotd-1.txt").unlink()  # whoever wrote it may clear it away, and use its name again
    system.scan(19.0)
    command(tmp_path, "robotd-1.txt", "FLASH;A3;3;1.0")
    system.scan(22.0)
    assert system.commands == 4


def test_a_flash_is_three_blinks_at_5_hz_each_second(tmp_path):
    command(tmp_path, "a.txt", "FLASH;A3;2;1.0")
    system = make_system(tmp_path, PROMPT)
    system.scan(4.0)
    t = 5.0 + np.arange(-100, 400) * 0.01
    seen = np.array([light(system, start, start + 0.01)[3] for start in t])
    expected = np.zeros(500)
    for second in (0, 1):
        for on, off in BURST:
            expected[100 + round(100 * (second + on)) : 100 + round(100 * (second + off))] = 1.0
    np.testing.assert_allclose(seen, expected, atol=1e-9)
    assert light(system, 0.0, 100.0)[3] * 100.0 == pytest.approx(0.6)
    assert light(system, 5.05, 5.25)[3] == pytest.approx(0.5)


def brute(flashes, rate, t0, t1, steps=20_000):
    """The definition, sampled: on inside a flash's periods and a burst's blinks."""
    t = t0 + (np.arange(steps) + 0.5) * (t1 - t0) / steps
    total = np.zeros(steps)
    for flash in flashes:
        phase = ((t - flash.start) * rate) % PERIOD_S
        blink = np.any([(on <= phase) & (phase < off) for on, off in BURST], axis=0)
        total += flash.strength * (blink & (flash.start <= t) & (t < flash.end))
    return total.mean()


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    t0=st.floats(0.0, 20.0),
    width=st.floats(1e-3, 5.0),
    orders=st.lists(st.tuples(st.integers(0, 7), st.integers(1, 4), st.sampled_from(["1.0", "0.5"])), max_size=20),
)
def test_light_is_the_exact_mean_over_the_interval(tmp_path_factory, seed, t0, width, orders):
    folder = tmp_path_factory.mktemp("labels")
    system = make_system(folder, LabelSystemSettings(clock_error=0.05), seed=seed)
    command(folder, "a.txt", *(f"FLASH;A{label};{seconds};{strength}" for label, seconds, strength in orders[::2]))
    system.scan(2.0)
    command(folder, "b.txt", *(f"FLASH;A{label};{seconds};{strength}" for label, seconds, strength in orders[1::2]))
    system.scan(3.0)
    seen = light(system, t0, t0 + width)
    for index in range(8):
        expected = brute(system._flashes[index], system._rate[index], t0, t0 + width)
        assert seen[index] == pytest.approx(expected, abs=2e-3)
    halves = light(system, t0, t0 + width / 2) + light(system, t0 + width / 2, t0 + width)
    np.testing.assert_allclose(seen, halves / 2, atol=1e-9)


def test_every_label_has_its_own_interval(tmp_path):
    command(tmp_path, "a.txt", *(f"FLASH;{label};3;1" for label in IDS))
    system = make_system(tmp_path, PROMPT)
    system.scan(0.0)
    t0 = 1.0 + 0.1 * np.arange(8)
    np.testing.assert_allclose(system.lit(t0, t0 + 0.1), [1, 0, 1, 0, 1, 0, 0, 0], atol=1e-4)
    many = t0 + np.arange(12).reshape(3, 4, 1) * 0.07
    one_by_one = [[system.lit(t, t + 0.05) for t in row] for row in many]
    np.testing.assert_array_equal(system.lit(many, many + 0.05), one_by_one)
    assert system.lit(many + 100, many + 101).shape == (3, 4, 8)


def test_a_new_command_replaces_the_flash_that_is_running(tmp_path):
    system = make_system(tmp_path, PROMPT)
    command(tmp_path, "a.txt", "FLASH;A0;10;1.0")
    system.scan(0.0)
    command(tmp_path, "b.txt", "FLASH;A0;1;0.5")
    system.scan(2.25)
    assert light(system, 3.2, 3.25)[0] == pytest.approx(1.0)
    assert light(system, 3.25, 3.35)[0] == pytest.approx(0.5)
    assert light(system, 3.35, 3.45)[0] == pytest.approx(0.0)
    assert light(system, 4.25, 20.0)[0] == 0.0


def test_what_was_said_about_the_past_never_changes(tmp_path):
    rng = np.random.default_rng(5)
    system = make_system(tmp_path, LabelSystemSettings(delay_median_s=0.05, delay_p95_s=3.0))
    for scan in range(40):
        t = 3.0 * scan
        begin = t - rng.uniform(0.0, 0.2, 8)
        end = begin + rng.uniform(0.0, 1.0, 8) * (t - begin) + 1e-6
        before = system.lit(begin, end)
        orders = [f"FLASH;A{rng.integers(8)};{rng.integers(1, 9)};1.0" for _ in range(rng.integers(0, 12))]
        command(tmp_path, "a.txt", *orders)
        system.scan(t)
        np.testing.assert_allclose(system.lit(begin, end), before, atol=1e-5)


def test_delays_losses_and_clock_errors_have_the_promised_statistics(tmp_path):
    ids = [str(number) for number in range(4000)]
    system = make_system(tmp_path, LabelSystemSettings(commands_per_s=1e6), ids=ids, seed=3)
    command(tmp_path, "a.txt", *(f"FLASH;{label};1;1.0" for label in ids))
    system.scan(0.0)
    delays = np.array([flashes[0].start for flashes in system._flashes if flashes])
    assert system.commands == 4000
    assert system.lost == 4000 - len(delays)
    assert 0.012 < system.lost / 4000 < 0.028
    assert np.median(delays) == pytest.approx(1.0, rel=0.06)
    assert np.quantile(delays, 0.95) == pytest.approx(3.0, rel=0.1)
    assert np.std(system._rate - 1.0) == pytest.approx(0.001, rel=0.06)


def test_weak_batteries_make_dim_lights_that_often_do_not_answer(tmp_path):
    ids = [str(number) for number in range(2000)]
    settings = LabelSystemSettings(commands_per_s=1e6, weak_fraction=0.25, weak_light=0.4, weak_lost_fraction=0.3)
    system = make_system(tmp_path, settings, ids=ids, seed=4)
    command(tmp_path, "a.txt", *(f"FLASH;{label};1;1.0" for label in ids))
    system.scan(0.0)
    assert system.weak.sum() == 500
    lit = np.array([bool(flashes) for flashes in system._flashes])
    assert 0.62 < lit[system.weak].mean() < 0.76
    assert lit[~system.weak].mean() > 0.96
    strengths = {
        flashes[0].strength for flashes, weak in zip(system._flashes, system.weak, strict=True) if flashes and weak
    }
    assert strengths == {0.4}


def test_the_same_seed_gives_the_same_light(tmp_path):
    def run(seed):
        system = make_system(tmp_path, LabelSystemSettings(), seed=seed)
        command(tmp_path, "a.txt", *(f"FLASH;{label};3;1.0" for label in IDS))
        system.scan(0.0)
        return np.array([light(system, t, t + 0.03) for t in np.arange(0.0, 8.0, 0.1)])

    np.testing.assert_array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))


def test_half_written_and_foreign_files_do_no_harm(tmp_path):
    system = make_system(tmp_path, PROMPT)
    (tmp_path / "half.txt").write_text("FLASH;A0;3;1.0\nFLASH;A1;3")
    (tmp_path / "notes.md").write_text("FLASH;A2;3;1.0\n")
    (tmp_path / "folder.txt").mkdir()
    (tmp_path / "noise.txt").write_bytes(bytes(range(256)) + b"\n")
    command(
        tmp_path,
        "odd.txt",
        "FLASH;A3;0;1.0",
        "FLASH;A3;3;nan",
        "FLASH;A3;3;1e999",
        "FLASH;;3;1",
        "GLOW;A3;3;1",
        "",
        "ÄÖ",
    )
    command(tmp_path, "other.txt", "FLASH;B7;3;1.0")
    system.scan(0.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.txt", "half.txt", "notes.md"]
    assert (system.commands, system.lost) == (1, 1)
    assert system.ignored >= 6
    assert not light(system, 0.0, 10.0).any()
    with (tmp_path / "half.txt").open("a") as file:
        file.write(";1.0\n")
    system.scan(3.0)
    assert (light(system, 3.0, 8.0) > 0).tolist() == [True, True, *[False] * 6]
    (tmp_path / "half.txt").write_text("FLASH;A5;3;1.0")
    for scan in range(3):
        assert (tmp_path / "half.txt").exists()
        system.scan(10.0 + scan)
    assert not (tmp_path / "half.txt").exists()
    assert light(system, 13.0, 14.0)[5] > 0


def test_it_understands_what_the_gateway_writes(tmp_path):
    outbox = Outbox(tmp_path)
    outbox.open()
    outbox.flash(["A0", "A5"], [3, 3], 1.0, None, "test")
    outbox.flash(["A6"], [1], 1e-05, None, "test")
    system = make_system(tmp_path, PROMPT)
    system.scan(0.0)
    assert (system.commands, system.lost, system.ignored) == (3, 0, 0)
    assert np.flatnonzero(light(system, 0.0, 5.0)).tolist() == [0, 5, 6]
    assert outbox.waiting() == 0


def test_no_labels_and_no_folder_are_bearable(tmp_path):
    system = make_system(tmp_path / "gone", ids=[])
    system.scan(0.0)
    assert system.lit(np.zeros(0), np.zeros(0)).shape == (0,)


def test_rendering_threads_may_read_while_the_folder_is_scanned(tmp_path):
    system = make_system(tmp_path, LabelSystemSettings())

    def render(worker):
        return all(0.0 <= light(system, 0.01 * step, 0.01 * step + 0.02).max() <= 1.0 + 1e-9 for step in range(300))

    with ThreadPoolExecutor(3) as pool:
        jobs = [pool.submit(render, worker) for worker in range(3)]
        for scan in range(50):
            command(tmp_path, "a.txt", *(f"FLASH;{label};2;1.0" for label in IDS))
            system.scan(0.1 * scan)
        assert all(job.result() for job in jobs)


def test_settings_are_checked():
    with pytest.raises(ConfigError, match="delay_p95_s"):
        bind(LabelSystemSettings, {"delay_median_s": 2.0, "delay_p95_s": 1.0}, "world.toml")
    with pytest.raises(ConfigError, match=r"lost_fraction: found 2; expected 0 to 1"):
        bind(LabelSystemSettings, {"lost_fraction": 2}, "world.toml")
