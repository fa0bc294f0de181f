"""Which label is which light: what to ask the label system, and what the answers mean.

The label system gives no feedback: it is polled, sends commands one after the other, every label starts after its own
unknown delay, and some commands are lost. The length of a flash is ours, though, and so is the order of the commands.

`settings` what must be known beforehand. `inquiry` chooses which labels flash in a slot, when and for how long, `pace`
how many of them a stop has time for;
`identifier` sees what flashed in the cameras; `decoder` turns that into probabilities, with `delays` and `throughput`
for the timing and `memory` for where known labels must appear, which `alignment` sharpens. `code` has the fixed code
words of the scheme that does not adapt.
"""

from .delays import DelayModel
from .identifier import Identifier
from .memory import LabelMemory
from .settings import FlashRequest, IdentifyConfig, Slot

__all__ = ["DelayModel", "FlashRequest", "Identifier", "IdentifyConfig", "LabelMemory", "Slot"]
