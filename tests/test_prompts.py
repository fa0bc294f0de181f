"""A person who is asked by a driver, and answers over the control socket."""

import asyncio

from robotd.clock import now
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

    operated(tmp_path, scenario)
