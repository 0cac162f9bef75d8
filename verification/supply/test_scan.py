"""What a scan says when there is something to say, and when no one could be asked."""

from verification.supply.scan import judged


def test_an_audit_without_a_source_reports_that_nothing_was_audited(capsys):
    assert judged("a.lock", [{"name": "a", "skip_reason": "not found"}]) == 0
    assert "NOTHING WAS AUDITED" in capsys.readouterr().out


def test_a_known_vulnerability_fails_the_scan(capsys):
    found = [{"name": "a", "version": "1", "vulns": [{"id": "X-1"}]}, {"name": "b", "version": "1", "vulns": []}]
    assert judged("a.lock", found) == 1
    assert "X-1" in capsys.readouterr().out


def test_packages_without_any_pass(capsys):
    assert judged("a.lock", [{"name": "b", "version": "1", "vulns": []}]) == 0
    assert "0 of 1 packages" in capsys.readouterr().out
