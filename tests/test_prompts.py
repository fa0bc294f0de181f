"""A person who is asked by a driver, and answers over the control socket."""

import asyncio
import io
from argparse import Namespace

import pytest

from robotd.clock import now
from robotd.ctl import prompts
from robotd.ctl.errors import REFUSED, CtlError
from robotd.records import Prompt
from tests.operated import operated


def test_a_prompt_is_shown_and_its_answer_reaches_whoever_asked(tmp_path):
    async def scenario(robot, client):
        bus = robot.course.bus
        assert await client.call("prompts.list") == {"prompts": []}
        with bus.answers.subscribe() as answers:
            bus.prompts.publish(Prompt(now(), "labels", 7, "have A1 flash"))
            (asked,) = (await client.call("prompts.list"))["prompts"]
            assert (asked["source"], asked["number"], asked["text"]) == ("labels", 7, "have A1 flash")
            assert await client.call("prompts.answer", text=" skip A1 ") == {"source": "labels", "number": 7}
            async with asyncio.timeout(1.0):
                said = await answers.get()
        assert (said.source, said.number, said.text) == ("labels", 7, "skip A1")
        assert await client.call("prompts.list") == {"prompts": []}

    operated(tmp_path, scenario)


def test_an_answer_to_what_is_not_asked_is_refused(tmp_path):
    async def scenario(robot, client):
        assert "nothing is asked" in (await client.call("prompts.answer", text="done"))["message"]
        robot.course.bus.prompts.publish(Prompt(now(), "labels", 8, "have A2 flash"))
        late = (await client.call("prompts.answer", text="done", source="labels", number=7))["message"]
        assert "have A2 flash" in late
        robot.course.bus.prompts.publish(Prompt(now(), "labels", 9, ""))  # taken back
        assert await client.call("prompts.list") == {"prompts": []}
        assert "nothing is asked" in (await client.call("prompts.answer", text="done"))["message"]

    operated(tmp_path, scenario)


class Robot:
    """What robotctl is connected to: prompts come one after the other; those in `late` are answered elsewhere first."""

    def __init__(self, *texts, late=()):
        self.texts, self.late, self.said = dict(enumerate(texts)), set(late), []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def call(self, method, params):
        number = min(self.texts, default=None)
        if method == "prompts.list":
            if number is None:
                raise KeyboardInterrupt
            return {"prompts": [{"source": "labels", "number": number, "text": self.texts[number]}]}
        text = self.texts.pop(number)
        if number in self.late:
            raise CtlError(REFUSED, "that is not asked any more")
        self.said.append((text, params["text"].strip(), params["number"]))
        return {"source": "labels", "number": number}


def test_following_prompts_shows_each_once_and_survives_answers_that_come_too_late(monkeypatch, capsys):
    robot = Robot("one", "two", "three", late=[1])
    monkeypatch.setattr(prompts, "connect", lambda _: robot)
    monkeypatch.setattr("sys.stdin", io.StringIO("done\nskip A1\ndone\n"))
    with pytest.raises(KeyboardInterrupt):  # as Ctrl-C, when all is asked
        prompts.prompts(Namespace(follow=True, json=False))
    assert robot.said == [("one", "done", 0), ("three", "done", 2)]
    shown = capsys.readouterr().out.splitlines()
    assert shown == ["labels: one", "labels: two", "that is not asked any more", "labels: three"]


def test_following_ends_with_its_input(monkeypatch):
    monkeypatch.setattr(prompts, "connect", lambda _: Robot("one", "two"))
    monkeypatch.setattr("sys.stdin", io.StringIO("done\n"))
    assert prompts.prompts(Namespace(follow=True, json=False)) == 0
