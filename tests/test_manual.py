"""A person as the label system: prompts over the bus, answers from wherever they come."""

import asyncio
import os
from types import SimpleNamespace

import pytest
from robotd.drivers.manual import ManualConfig, ManualDriver

from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.errors import ConfigError, DriverFault
from robotd.plugin import Labels, load
from robotd.prompt import converse
from robotd.records import Answer


def make_driver(**settings):
    config = bind(ManualConfig, settings, "robotd.toml [drivers.labels]")
    return ManualDriver("labels", config, SimpleNamespace(), Bus(), SimpleNamespace())


async def person(bus, *replies, after=2.0):
    """Answers prompt after prompt; returns the prompts' texts."""
    texts = []
    with bus.prompts.subscribe() as prompts:
        for reply in replies:
            while not (prompt := await prompts.get()).text:
                pass  # the one before is taken back
            texts.append(prompt.text)
            await asyncio.sleep(after)
            bus.answers.publish(Answer(now(), prompt.source, prompt.number, reply))
    return texts


def converse_with(driver, labels, durations, *replies):
    async def run():
        await driver.open()
        talk = asyncio.create_task(person(driver.bus, *replies))
        await asyncio.sleep(0)
        refused = await driver.flash(labels, 1.0, durations)
        texts = await talk
        await driver.close()
        return refused, texts, now()

    return run_virtual(run())


def test_it_is_installed_as_a_label_driver():
    assert load("manual", "here") is ManualDriver
    assert ManualDriver.kind == "labels"
    assert isinstance(make_driver(), Labels)


def test_a_request_is_a_prompt_and_ends_with_the_answer():
    refused, texts, t = converse_with(make_driver(), ["A1", "A2"], [3, 5], "done")
    assert refused == {}
    assert t == 2.0
    assert texts == [
        "have these flash now, in this order: A1 for 3 s, A2 for 5 s; then answer 'done', or 'skip' and their ids"
    ]


def test_long_requests_are_cut_into_prompts_and_skipped_labels_are_refused():
    labels = [f"A{k}" for k in range(5)]
    refused, texts, _ = converse_with(make_driver(at_once=2), labels, [2] * 5, "done", "skip A3", "skip")
    assert [text.count(" for ") for text in texts] == [2, 2, 1]
    assert refused.keys() == {"A3", "A4"}


def test_an_answer_that_makes_no_sense_is_reported_and_the_prompt_stays():
    driver = make_driver()

    async def run():
        await driver.open()
        with driver.bus.events.subscribe() as events:
            work = asyncio.create_task(driver.flash(["A1"], 0.5, [3]))
            await asyncio.sleep(1.0)
            assert "at 50 % brightness" in driver.bus.prompts.latest.text
            for number, text in enumerate(("skip B7", "what", "done now"), start=1):
                driver.bus.answers.publish(Answer(now(), "labels", number, text))
                await asyncio.sleep(1.0)
                assert f"'{text}' was not understood" in (await events.get()).text
                asked = driver.bus.prompts.latest  # anew: it would look answered
                assert asked.number == number + 1
                assert asked.text.startswith(f"'{text}' was not understood; expected 'done'")
                assert asked.text.endswith("then answer 'done', or 'skip' and their ids")
            driver.bus.answers.publish(Answer(now(), "labels", 7, "done"))  # of another prompt
            driver.bus.answers.publish(Answer(now(), "other", 4, "done"))
            await asyncio.sleep(1.0)
            assert not work.done()
            driver.bus.answers.publish(Answer(now(), "labels", 4, ""))
            assert await work == {}
            assert driver.bus.prompts.latest.text == ""  # nothing is asked any more

    run_virtual(run())


def test_without_an_answer_the_driver_is_at_fault():
    driver = make_driver(patience_s=30.0)

    async def run():
        await driver.open()
        watch = asyncio.create_task(driver.run())
        with pytest.raises(DriverFault, match="labels: nobody answered within 30 s: have these flash now"):
            await driver.flash(["A1"], 1.0, [3])
        with pytest.raises(DriverFault, match="nobody answered"):
            await watch
        assert now() == 30.0
        assert driver.bus.prompts.latest.text == ""
        await driver.close()

    run_virtual(run())


def test_what_is_typed_on_a_terminal_answers_the_latest_prompt():
    driver = make_driver()
    shown = []

    async def run():
        read, write = os.pipe()
        try:
            await driver.open()
            talk = asyncio.create_task(converse(driver.bus, read, shown.append))
            os.write(write, b"too early\n")
            async with asyncio.timeout(10.0):
                while not shown:
                    await asyncio.sleep(0.01)
                work = asyncio.create_task(driver.flash(["A1", "A2"], 1.0, [3, 3]))
                while len(shown) < 2:
                    await asyncio.sleep(0.01)
                os.write(write, b"skip ")
                os.write(write, b"A2\n")
                assert (await work).keys() == {"A2"}
                work = asyncio.create_task(driver.flash(["A1"], 1.0, [3]))
                while len(shown) < 3:
                    await asyncio.sleep(0.01)
                os.write(write, b"\n")
                assert await work == {}
                os.close(write)
                await talk
        finally:
            os.close(read)

    asyncio.run(run())
    assert shown[0] == "nothing is asked at present"
    assert shown[1].startswith("labels: have these flash now")


def test_the_section_is_checked():
    with pytest.raises(ConfigError, match="at_once: found 0; expected 1 to 100"):
        make_driver(at_once=0)
