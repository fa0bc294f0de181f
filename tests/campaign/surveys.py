"""The long run: whole surveys over many seeds, in the world as it is and in a harsher one, with cables pulled out."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from robotd.__main__ import main
from robotd.sim.world import World

STORE = Path(__file__).parents[1] / "stores" / "corner.toml"
HARSH = """
[world]
travel_noise = 0.006
tilt = 0.010
drop = 0.05
[world.sensor]
read_noise = 3.0
[world.labels]
lost_fraction = 0.10
"""


def run_demo(out, seed, capsys, *more):
    code = main(["demo", "--store", str(STORE), "--seed", str(seed), "--out", str(out), "--json", *more])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    return json.loads(printed.out)


@pytest.mark.parametrize("seed", range(1, 21))
def test_the_visible_labels_are_placed_whatever_the_seed(seed, tmp_path, capsys):
    result = run_demo(tmp_path, seed, capsys)
    assert result["labels_placed"] >= 5
    assert result["error_mm"]["mean"] <= 25.0


@pytest.mark.parametrize("seed", range(1, 11))
def test_a_harsher_world_costs_accuracy_but_places_nothing_wrongly(seed, tmp_path, capsys):
    harsh = tmp_path / "harsh.toml"
    harsh.write_text(HARSH)
    result = run_demo(tmp_path / "out", seed, capsys, "--world", str(harsh))
    assert result["error_mm"]["max"] is None or result["error_mm"]["max"] <= 150.0


@pytest.mark.parametrize("seed", range(1, 11))
def test_cameras_pulled_out_at_random_times_cost_no_stop(seed, tmp_path, capsys, monkeypatch):
    class Clumsy(World):
        async def run(self):
            rng = np.random.default_rng(seed)

            async def pull():
                while True:
                    await asyncio.sleep(rng.uniform(10.0, 60.0))
                    device = f"/dev/robotd/{rng.choice(['front', 'left', 'rear', 'right'])}"
                    self.unplug(device)
                    await asyncio.sleep(rng.uniform(0.5, 8.0))
                    self.plug(device)

            async with asyncio.TaskGroup() as group:
                group.create_task(super().run())
                group.create_task(pull())

    monkeypatch.setattr("robotd.demo.World", Clumsy)
    result = run_demo(tmp_path, seed, capsys)
    assert result["stops"] == 3
    assert result["labels_placed"] >= 5
