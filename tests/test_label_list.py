"""Where the labels to look for come from: the configuration, a file, the server or the label system."""

import asyncio
import json
from dataclasses import replace

import pytest
from hypothesis import given, strategies as st
from robotd.drivers.pricer import PricerConfig, PricerDriver

from robotd.bus import Bus
from robotd.clock import run_virtual
from robotd.config import MissionConfig, Zone
from robotd.errors import DriverFault, InputError, MissionError
from robotd.gateway import Gateway, Outbox
from robotd.label_list import read_labels
from robotd.label_source import LabelSource
from robotd.server.store import Store, UnknownSurveyError
from tests.operated import operated

IDS = st.lists(st.from_regex(r"[A-Za-z0-9_.-]{1,12}", fullmatch=True), min_size=1, max_size=20, unique=True).filter(
    lambda ids: ids[0].lower() != "label"
)


@given(IDS, st.sampled_from([",", ";", "\t"]), st.booleans())
def test_a_list_of_lines_and_a_table_say_the_same(ids, mark, is_dos):
    end = "\r\n" if is_dos else "\n"
    lines = f"# export{end}{end}" + end.join(f"  {label}  # shelf" for label in ids)
    assert read_labels(lines, "list") == tuple(ids)
    table = f"\ufeffprice{mark}Label{mark}x{end}" + end.join(f"9{mark}{label}{mark}1" for label in ids) + end
    assert read_labels(table, "list") == tuple(ids)


def test_every_mistake_in_a_list_is_named():
    with pytest.raises(InputError) as caught:
        read_labels("A1\nA2 A3\nA1\n\nB C\n", "labels.txt")
    assert caught.value.problems == (
        "labels.txt line 2: found 'A2 A3'; expected one id",
        "labels.txt line 5: found 'B C'; expected one id",
        "labels.txt: A1 listed more than once; expected every id once",
    )
    with pytest.raises(InputError, match="line 3: found no label"):
        read_labels("label,x\nA1,2\n,3\n", "list")
    with pytest.raises(InputError, match="found no label; expected one id a line"):
        read_labels("# nothing\n", "list")


# ---- who is asked ----------------------------------------------------------------------------------------------------


class Shop:
    """A label system that says what it is told to, or fails."""

    name = "labels"
    text = "A1\nA2\n"
    fault = None

    async def listed(self):
        if self.text is None:
            raise DriverFault("labels: unplugged")
        return self.text


def read(folder, labels=None, *, goes_on=False, warnings=None, **config):
    warn = ([] if warnings is None else warnings).append
    source = LabelSource(folder, folder, labels, lambda: getattr(labels, "fault", None), None, warn)
    return run_virtual(source.labels(MissionConfig(**config), "store", goes_on=goes_on))


def test_labels_come_from_where_the_configuration_says(tmp_path):
    (tmp_path / "mine.csv").write_text("Label;Price\nB1;1\nB2;3\n")
    assert read(tmp_path, labels=None) == ()
    assert read(tmp_path, labels_from="file", labels_file=tmp_path / "mine.csv") == ("B1", "B2")
    assert read(tmp_path, Shop(), labels_from="system") == ("A1", "A2")
    with pytest.raises(MissionError, match="this driver cannot list its labels"):
        read(tmp_path / "no", type("Manual", (), {"name": "manual"})(), labels_from="system")
    with pytest.raises(MissionError, match=r"no server: set \[upload\] url"):
        read(tmp_path / "no", labels_from="server")
    (tmp_path / "mine.csv").write_bytes(b"\xff")
    with pytest.raises(InputError, match="not UTF-8 at byte 0"):
        read(tmp_path, labels_from="file", labels_file=tmp_path / "mine.csv")
    with pytest.raises(InputError, match=r"zones.*: B9 not among the labels"):
        read(tmp_path, Shop(), labels_from="system", zones=(Zone(("B9",), 0.0, 1.0),))


def test_a_source_that_cannot_be_asked_is_replaced_by_what_it_said_last(tmp_path):
    shop, warnings = Shop(), []
    shop.text = None
    with pytest.raises(MissionError, match="no list of labels: labels: unplugged"):
        read(tmp_path, shop, labels_from="system")
    shop.text = "A1\nA2\n"
    read(tmp_path, shop, labels_from="system")
    shop.text = None
    assert read(tmp_path, shop, labels_from="system", warnings=warnings) == ("A1", "A2")
    assert warnings == ["the list of labels is the last one: labels: unplugged"]
    shop.text = "A3\n"
    shop.fault = "labels: not opened yet"
    assert read(tmp_path, shop, labels_from="system", warnings=warnings) == ("A1", "A2")
    assert warnings[1:] == ["the list of labels is the last one: labels: not opened yet"]
    shop.fault = None
    assert read(tmp_path, shop, labels_from="system", goes_on=True) == ("A1", "A2")
    assert read(tmp_path, shop, labels_from="system") == ("A3",)


def test_the_gateways_list_comes_in_pieces_and_anew_when_it_changes(tmp_path, monkeypatch):
    monkeypatch.setattr("robotd.gateway.TEXT_PIECE", 100)
    (tmp_path / "folder").mkdir()
    listed = tmp_path / "labels.csv"
    gateway = Gateway(Outbox(tmp_path / "folder"), None, listed)
    driver = PricerDriver("labels", PricerConfig(port=1), None, Bus(), None)
    asked = []

    async def ask(request):
        asked.append(request["start"])
        if asked == [0, 100]:
            listed.write_text("label\n" + "\n".join(f"ö{k}" for k in range(80)))
        return json.loads(gateway.answer(json.dumps({"id": 1, **request}).encode()))

    driver._ask = ask
    with pytest.raises(DriverFault, match=r"refuses: --labels .*labels.csv: .*No such file"):
        asyncio.run(driver.listed())
    listed.write_text("label\n" + "\n".join(f"A{k}" for k in range(80)))
    asked.clear()
    assert read_labels(asyncio.run(driver.listed()), "list") == tuple(f"ö{k}" for k in range(80))
    assert asked == [0, 100, 0, 100, 200, 300]
    bad = Gateway(gateway.outbox, None).answer(b'{"method": "labels"}')
    assert "start it with --labels FILE" in json.loads(bad)["error"]
    assert "start: found -1" in json.loads(gateway.answer(b'{"method": "labels", "start": -1}'))["error"]


def test_the_server_gives_a_surveys_own_list_or_the_one_for_all(tmp_path):
    store = Store(tmp_path)
    with pytest.raises(UnknownSurveyError, match="write one id a line into"):
        store.labels("Laden 1")
    (tmp_path / "labels.txt").write_text("A1\n")
    assert store.labels("Laden 1") == b"A1\n"
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "Laden%201.txt").write_text("B1\n")
    assert (store.labels("Laden 1"), store.labels("other")) == (b"B1\n", b"A1\n")


def test_a_mission_looks_for_the_labels_of_its_source_and_is_refused_without_any(tmp_path):
    async def scenario(robot, client):
        assert "no list of labels" in (await client.call("mission.start"))["message"]
        (tmp_path / "labels.txt").write_text("A1 A2\n")
        daemon = robot.daemon
        config = replace(daemon.assembly.config.mission, labels_from="file")
        daemon.assembly = replace(daemon.assembly, config=replace(daemon.assembly.config, mission=config))
        assert "line 1: found 'A1 A2'" in (await client.call("mission.start"))["message"]
        (tmp_path / "labels.txt").write_text("A1\nA2\n")
        await client.call("mission.start")
        await robot.until("observing", 1)
        assert daemon.mission.config.labels == ("A1", "A2")
        await client.call("mission.abort")

    operated(tmp_path, scenario, labels=(), labels_from="server")
