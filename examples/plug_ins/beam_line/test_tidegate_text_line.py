"""Its drills, on a device: TEXT_LINE=HOST:PORT pytest."""

import os

from tidegate_text_line import TextWire

from tidegate.testing import WireRules


class TestTextLine(WireRules):
    def make(self) -> TextWire:
        return TextWire(os.environ["TEXT_LINE"])
