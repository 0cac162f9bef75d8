"""The list of what is sent: kept over restarts, damaged files said, one that was asked for again not called sent."""

from service.exchange.outbox import FOLDER, Outbox

ONE, TWO = "5e" * 16, "6f" * 16


def test_what_was_asked_for_is_known_after_a_restart(tmp_path):
    Outbox(tmp_path).ask(ONE, "B. Physicist")
    (found,) = Outbox(tmp_path).waiting()
    assert (found.session_id, found.asked_by, found.state, found.tries) == (ONE, "B. Physicist", "waiting", 0)


def test_failures_are_counted_and_the_newest_reason_stands(tmp_path):
    outbox = Outbox(tmp_path)
    outbox.ask(ONE, "B. Physicist")
    for reason in ("refused", "does not answer"):
        outbox.has_failed(outbox.waiting()[0], reason)
    (found,) = outbox.all()
    assert (found.tries, found.trouble, found.sent_at) == (2, "does not answer", None)


def test_sent_is_no_longer_waiting_and_oldest_come_first(tmp_path):
    outbox = Outbox(tmp_path)
    first = outbox.ask(TWO, "B. Physicist")
    outbox.ask(ONE, "A. Therapist")
    outbox.has_sent(first)
    assert [one.session_id for one in outbox.all()] == [TWO, ONE]
    assert [one.session_id for one in outbox.waiting()] == [ONE]
    assert outbox.all()[0].sent_at is not None


def test_asked_for_again_while_it_is_on_its_way_it_is_sent_again(tmp_path):
    outbox = Outbox(tmp_path)
    on_its_way = outbox.ask(ONE, "B. Physicist")
    outbox.ask(ONE, "A. Therapist")
    outbox.has_sent(on_its_way)
    (found,) = outbox.waiting()
    assert found.asked_by == "A. Therapist"


def test_a_loss_that_is_told_before_the_sending_is_noted_counts(tmp_path):
    outbox = Outbox(tmp_path)
    sending = outbox.ask(ONE, "B. Physicist")
    outbox.begin(sending, "2.25.1")
    outbox.has_lost(outbox.all()[0], "the PACS does not keep it")
    outbox.has_sent(sending, "2.25.1", is_asked=True)
    (found,) = outbox.waiting()
    assert (found.trouble, found.transaction) == ("the PACS does not keep it", "")


def test_a_confirmation_before_the_sending_is_noted_stays(tmp_path):
    outbox = Outbox(tmp_path)
    sending = outbox.ask(ONE, "B. Physicist")
    outbox.begin(sending, "2.25.1")
    outbox.has_committed(outbox.all()[0])
    outbox.has_sent(sending, "2.25.1", is_asked=True)
    (found,) = outbox.all()
    assert (found.state, found.transaction) == ("sent", "2.25.1")
    assert found.committed_at is not None


def test_a_damaged_file_is_said_and_hides_no_other(tmp_path):
    outbox = Outbox(tmp_path)
    outbox.ask(ONE, "B. Physicist")
    for name, text in ((TWO, '{"session_id": "6f'), ("7a" * 16, "[1]"), ("8b" * 16, '{"unknown": 1}')):
        (tmp_path / FOLDER / f"{name}.json").write_text(text)
    assert [one.session_id for one in outbox.waiting() if one.asked_by] == [ONE]
    assert sum("damaged" in one.trouble for one in outbox.all()) == 3
    outbox.ask(TWO, "B. Physicist")
    assert {one.session_id for one in outbox.waiting() if one.asked_by} == {ONE, TWO}


def test_only_the_service_s_account_reads_the_folder(tmp_path):
    Outbox(tmp_path).ask(ONE, "B. Physicist")
    assert (tmp_path / FOLDER).stat().st_mode & 0o077 == 0
