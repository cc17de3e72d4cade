"""Decoding of Prophesee's EVT words, from files and from the packets of a bag."""

from types import ModuleType

import numpy as np

from jaxcal.recording.formats.contract import EventColumns, Triggers

# Bytes per word of each encoding; evt21-legacy has the halves of its words in the other order.
WORD_BYTES = {"evt2": 4, "evt21": 8, "evt21-legacy": 8, "evt3": 2}


class WordDecoder:
    """Decodes the words of one recording, handed over part by part in their order."""

    def __init__(self, encoding: str) -> None:
        """`encoding`: a key of `WORD_BYTES`."""
        self.encoding = encoding
        self._state = _kernels().initial_state()

    def copy(self) -> "WordDecoder":
        """A decoder that goes on from here, independent of this one."""
        other = WordDecoder(self.encoding)
        other._state = self._state.copy()
        return other

    def decode(self, content: bytes | memoryview) -> tuple[EventColumns, Triggers]:
        """The events and triggers in some whole words."""
        kernels = _kernels()
        words = self._words(content)
        count, decode = (kernels.count_3, kernels.decode_3) if len(words) == 1 else (kernels.count_2, kernels.decode_2)
        events, triggers = count(*words)
        t_ns, x, y, p = (np.empty(events, kind) for kind in (np.int64, np.uint16, np.uint16, np.bool_))
        at_ns, channel, rising = (np.empty(triggers, kind) for kind in (np.int64, np.int64, np.bool_))
        found, edges = decode(*words, self._state, t_ns, x, y, p, at_ns, channel, rising)
        columns = EventColumns(0, t_ns[:found], x[:found], y[:found], p[:found])
        return columns, Triggers(at_ns[:edges], channel[:edges], rising[:edges])

    def remarks(self) -> list[str]:
        """What was odd so far, in sentences."""
        return _kernels().state_remarks(self._state)

    def _words(self, content: bytes | memoryview) -> tuple[np.ndarray, ...]:
        """What the kernels take; all of it read-only, so that one compiled program serves EVT2 and EVT2.1."""
        if self.encoding == "evt3":
            return (np.frombuffer(content, "<u2"),)
        words = np.frombuffer(content, "<u4")
        if self.encoding == "evt2":
            return words, words[:0]
        upper, lower = (0, 1) if self.encoding == "evt21-legacy" else (1, 0)
        halves = np.ascontiguousarray(words[upper::2]), np.ascontiguousarray(words[lower::2])
        for half in halves:
            half.flags.writeable = False
        return halves


def _kernels() -> ModuleType:
    """The compiled loops, imported when needed: numba takes its time."""
    from jaxcal.recording.formats import evt_words

    return evt_words
