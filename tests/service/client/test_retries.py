"""What is sent again when no one knows what became of it, and what never is."""

import pytest

from service.client import ProblemError, TidegateClient, UnreachableError
from tests.support.client.scripted_server import KEY, cuts, refuses, says, writes

SESSION = "0" * 32
NEVER_TWICE = (
    *("start", "set_reference", "sign_position", "countersign", "arm"),
    *("release", "acknowledge", "retrain", "apply_model"),
)
NEEDED = {"sign_position": {"reference_number": 1}, "countersign": {"state": "5e" * 16}}
TAKES_AWAY = ("hold", "disarm")
EMPTY_PAGE = {"items": [], "next_cursor": None}


@pytest.mark.parametrize("call", NEVER_TWICE)
@pytest.mark.parametrize("step", [cuts, refuses(503, "engine_timeout", Retry_After="0")], ids=["cut", "503"])
def test_what_could_lead_to_a_beam_is_sent_once_whatever_becomes_of_it(client, script, call, step):
    script.steps = [step]
    with pytest.raises((UnreachableError, ProblemError)):
        getattr(client, call)(SESSION, **NEEDED.get(call, {}))
    assert len(script.requests) == 1


def test_a_baseline_is_corrected_once(client, script):
    script.steps = [cuts]
    with pytest.raises(UnreachableError):
        client.correct_baseline(SESSION, by_mm=1.0, drift_mm=1.2)
    assert len(script.requests) == 1


@pytest.mark.parametrize("call", TAKES_AWAY)
def test_what_takes_the_beam_away_is_asked_for_until_somebody_answers(client, script, call):
    script.steps = [cuts, refuses(503, "engine_timeout"), cuts, says({})]
    with pytest.raises(Exception, match="is missing"):  # the fourth answer came, and is no session
        getattr(client, call)(SESSION)
    assert [one.path.rsplit("/", 1)[-1] for one in script.requests] == [call] * 4


def test_a_stop_whose_answer_was_lost_ends_with_the_session_as_it_is(client, script):
    script.steps = [cuts, refuses(409, "session_state"), refuses(404, "not_found")]
    with pytest.raises(ProblemError, match="not_found"):
        client.stop(SESSION)
    assert [(one.method, one.path) for one in script.requests] == [
        ("POST", f"/api/v1/sessions/{SESSION}/stop"),
        ("POST", f"/api/v1/sessions/{SESSION}/stop"),
        ("GET", f"/api/v1/sessions/{SESSION}"),
    ]


def test_arming_never_goes_over_a_connection_that_was_used_before(client, script):
    script.steps = [says(EMPTY_PAGE), says(EMPTY_PAGE), refuses(409, "command_refused")]
    list(client.sessions())
    list(client.sessions())
    with pytest.raises(ProblemError):
        client.arm(SESSION)
    first, second, arming = (one.connection for one in script.requests)
    assert first == second, "kept alive"
    assert arming != first


def test_creating_is_repeated_with_one_key_and_the_next_creation_has_another(client, script):
    script.steps = [cuts, refuses(503, "storage_unavailable"), refuses(409, "session_active")]
    for _ in range(2):
        with pytest.raises(ProblemError, match="session_active"):
            client.create_session({"patient_reference": "P-1"})
    keys = [one.headers["idempotency-key"] for one in script.requests]
    assert len(set(keys[:3])) == 1
    assert keys[3] != keys[0]


def test_a_key_of_the_caller_s_own_is_sent(client, script):
    script.steps = [refuses(409, "session_active")]
    with pytest.raises(ProblemError):
        client.create_session({}, idempotency_key="fraction-3")
    assert script.requests[0].headers["idempotency-key"] == "fraction-3"
    assert script.requests[0].json == {"operator": "A. Therapist"}


def test_reading_waits_for_the_given_time_and_raises_if_that_is_too_long(client, script, waits):
    script.steps = [refuses(503, "login_busy", Retry_After="7"), refuses(429, "locked_out", Retry_After="900")]
    with pytest.raises(ProblemError) as refused:
        client.me()
    assert waits == [7.0]
    assert (refused.value.code, refused.value.retry_after_s) == ("locked_out", 900.0)


def test_reading_is_given_up_after_so_many_attempts(client, script, waits):
    script.steps = [cuts]
    with pytest.raises(UnreachableError):
        client.me()
    assert len(script.requests) == 4
    assert waits == [0.2, 0.4, 0.8]


def test_a_refusal_that_stays_is_not_asked_for_again(client, script, waits):
    script.steps = [refuses(404, "not_found")]
    with pytest.raises(ProblemError):
        client.read_session(SESSION)
    assert (len(script.requests), waits) == (1, [])


def test_a_redirect_is_never_followed_with_the_key(client, script):
    script.steps = [lambda handler: handler.answer(307, b"", Location="http://127.0.0.1:1/elsewhere")]
    with pytest.raises(ProblemError) as refused:
        client.me()
    assert refused.value.status == 307
    assert len(script.requests) == 1


def test_a_connection_that_the_server_closed_meanwhile_is_replaced(client, script):
    last = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
    script.steps = [writes(last), says(EMPTY_PAGE)]
    with pytest.raises(Exception, match="is missing"):
        client.me()
    assert list(client.sessions()) == []


def test_a_certificate_that_cannot_be_verified_is_reported_at_once(script, waits):
    client = TidegateClient(f"https://127.0.0.1:{script.port}", key=KEY, timeout_s=2.0, sleep=waits.append)
    script.steps = [says({})]
    with pytest.raises(UnreachableError):
        client.me()
    assert script.requests == []
