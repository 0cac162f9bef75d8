"""Sentences keep what they were made from, wherever they are handed on as texts."""

import copy
import pickle

import pytest

from engine.core.sentences import Sentence, listed, say, word
from engine.core.signals import HeadDirection

MOVED = say("moved {shift_mm:.1f} mm along the couch, {allowed:g} allowed", shift_mm=3.14159, allowed=2.0)


def test_a_sentence_is_its_text_and_keeps_its_template_and_values():
    assert MOVED == "moved 3.1 mm along the couch, 2 allowed"
    assert MOVED.template == "moved {shift_mm} mm along the couch, {allowed} allowed"
    assert MOVED.values == {"shift_mm": "3.1", "allowed": "2"}


@pytest.mark.parametrize("hand_on", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_it_is_handed_to_another_process_whole(hand_on):
    found = hand_on(listed("; ", (MOVED, "other")))
    assert isinstance(found, Sentence)
    assert (found, found.template, found.values["part0"].template) == (
        f"{MOVED}; other",
        "{part0}; {part1}",
        MOVED.template,
    )


def test_a_sentence_and_a_word_in_a_sentence_stay_what_they_are():
    made = say("the patient {detail}, the head {side}", detail=MOVED, side=HeadDirection.TOP)
    assert made == f"the patient {MOVED}, the head top"
    assert made.values["detail"].template == MOVED.template
    assert made.values["side"] == word("top")
    assert isinstance(made.values["side"], Sentence)


@pytest.mark.parametrize("text", ["{shift_mm}", "{", "}{0}", "{}", "100 %"])
def test_braces_in_a_value_are_text(text: str):
    assert say("held by {holder}", holder=text) == f"held by {text}"
    assert listed(", ", (text, text)) == f"{text}, {text}"


def test_a_list_leaves_out_what_is_empty_and_one_part_is_itself():
    assert listed(", ", ("", MOVED, "")) is MOVED
    assert listed(", ", ("",)) == ""
    assert listed(", ", ("a", "", "b")) == "a, b"


def test_a_value_that_is_missing_is_an_error():
    with pytest.raises(KeyError, match="allowed"):
        say("{allowed} allowed")
