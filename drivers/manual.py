"""A person as the label system: asked which labels are to flash, triggers them by the store's own means."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..bind import ranged
from ..bus import Subscription
from ..clock import now
from ..errors import DriverFault
from ..plugin import Driver
from ..records import Answer, Prompt


@dataclass(frozen=True, slots=True, kw_only=True)
class ManualConfig:
    """[drivers.<instance>] of a person who triggers labels."""

    at_once: int = ranged(5, minimum=1, maximum=100)
    patience_s: float = ranged(600.0, minimum=1.0, maximum=86400.0)


class ManualDriver(Driver):
    """Prompts a person over `bus.prompts` and waits for what `bus.answers` says; see robotd.plugin.Labels.

    `done`: they flash, or will in a moment. `skip`: these labels cannot be triggered, or `skip A1 A2` those two.
    """

    kind = "labels"
    Config = ManualConfig
    config: ManualConfig
    _number = 0

    async def open(self) -> None:
        """Nothing to take: whoever shows prompts may come and go."""
        self._broken: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def run(self) -> None:
        """Wait until nobody answered; raises that DriverFault."""
        await self._broken

    async def flash(self, labels: Sequence[str], strength: float, durations: Sequence[int]) -> Mapping[str, str]:
        """Ask the person to have `labels` flash for their `durations` (s); returns the labels that were skipped.

        Raises
        ------
        DriverFault
            Nobody answered within `patience_s`.
        """
        refused: dict[str, str] = {}
        with self.bus.answers.subscribe() as answers:
            for start in range(0, len(labels), self.config.at_once):
                part = slice(start, start + self.config.at_once)
                skipped = await self._prompt(answers, labels[part], strength, durations[part])
                refused.update(dict.fromkeys(skipped, "skipped by the person who triggers labels"))
        return refused

    async def _prompt(
        self, answers: Subscription[Answer], labels: Sequence[str], strength: float, durations: Sequence[int]
    ) -> Sequence[str]:
        """Ask for these labels until the answer makes sense; returns those that were skipped."""
        wanted = ", ".join(f"{label} for {duration} s" for label, duration in zip(labels, durations, strict=True))
        level = "" if strength == 1.0 else f" at {100 * strength:.0f} % brightness"
        text = f"have these flash now{level}, in this order: {wanted}; then answer 'done', or 'skip' and their ids"
        self._say(text)
        try:
            async with asyncio.timeout(self.config.patience_s):
                while True:
                    answer = await answers.get()
                    if (answer.source, answer.number) != (self.name, self._number):
                        continue
                    word, *ids = answer.text.replace(",", " ").split() or ["done"]
                    if word == "done" and not ids:
                        return ()
                    if word == "skip" and set(ids) <= set(labels):
                        return ids or labels
                    unclear = f"'{answer.text}' was not understood; expected 'done', or 'skip' and ids of these labels"
                    self.report(unclear, "warning")
                    self._say(f"{unclear}; {text}")
        except TimeoutError:
            fault = f"{self.name}: nobody answered within {self.config.patience_s:g} s: {text}"
            if not self._broken.done():
                self._broken.set_exception(DriverFault(fault))
                self._broken.exception()  # it need not be fetched: the caller has its own
            raise DriverFault(fault) from None
        finally:
            self._say("")  # whoever comes now is not to trigger what nobody watches any more

    def _say(self, text: str) -> None:
        self._number += 1
        self.bus.prompts.publish(Prompt(now(), self.name, self._number, text))
