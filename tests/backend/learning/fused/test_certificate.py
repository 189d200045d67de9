"""Certificates: arithmetic against scipy and MAPIE, the log of attempts, the file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import beta, binomtest

from touchdown.backend.config import StackSettings
from touchdown.backend.core import InputError
from touchdown.backend.learning.fused.certificate import (
    TOTAL_ERROR,
    Attempt,
    AttemptLog,
    ReleaseCertificate,
    ReleaseClaim,
    ReleaseCounts,
    attempt_error,
    attempts_path,
    certificate_of_attempt,
    find_certificate,
    method_sha256,
    read_certificate,
    releases_needed,
    risk_bound,
    write_certificate,
)

METHOD = StackSettings(strategy="fused")
BENCH, WEIGHTS = "b" * 64, "a" * 64
# Counts whose plain 95 % bound is 1 %: the largest number of unsafe releases.
AT_ONE_PERCENT = ((0, 299), (1, 473), (4, 914), (18, 2760))


@pytest.mark.parametrize("error", [0.05, 0.025, 0.05 / 8])
@pytest.mark.parametrize("counts", [*AT_ONE_PERCENT, (3, 3), (0, 1), (1, 2), (999, 1000), (7, 30)])
def test_bound_is_that_of_scipy(counts: tuple[int, int], error: float) -> None:
    unsafe, releases = counts
    expected = (
        1.0 if unsafe == releases else float(beta.ppf(1 - error, unsafe + 1, releases - unsafe))
    )
    exact = binomtest(unsafe, releases, alternative="less").proportion_ci(1 - error, "exact")
    assert risk_bound(unsafe, releases, error) == pytest.approx(expected, rel=1e-9)
    assert risk_bound(unsafe, releases, error) == pytest.approx(float(exact.high), rel=1e-9)


@pytest.mark.parametrize("counts", AT_ONE_PERCENT)
def test_counts_of_one_percent_permit_no_more_unsafe_releases(counts: tuple[int, int]) -> None:
    unsafe, releases = counts
    assert risk_bound(unsafe, releases) <= 0.01
    assert risk_bound(unsafe + 1, releases) > 0.01


def test_bound_covers_the_true_probability_in_all_but_the_error() -> None:
    p, n = 0.01, 900
    drawn = np.random.default_rng(1).binomial(n, p, 20_000)
    bounds = np.array([risk_bound(k, n) for k in range(drawn.max() + 1)])
    assert np.mean(bounds[drawn] < p) <= TOTAL_ERROR + 0.005


def test_bound_agrees_with_the_test_of_mapie() -> None:
    # The p-value of MAPIE for binary losses (learn then test) is the exact binomial one.
    methods = pytest.importorskip("mapie.risk_control.methods")
    for unsafe, releases in (*AT_ONE_PERCENT, (19, 2760), (0, 298), (12, 2760)):
        rate = np.array([unsafe / releases])
        p = methods.compute_hoeffding_bentkus_p_value(rate, releases, np.array([0.01]), binary=True)
        assert (float(p[0, 0]) <= TOTAL_ERROR) == (risk_bound(unsafe, releases) <= 0.01)


@pytest.mark.parametrize(("limit", "error", "least"), [(0.01, 0.05, 299), (0.05, 0.05, 59)])
def test_releases_needed_without_an_event(limit: float, error: float, least: int) -> None:
    assert releases_needed(limit, error) == least
    assert risk_bound(0, least, error) <= limit < risk_bound(0, least - 1, error)


def test_all_attempts_and_levels_spend_five_percent_together() -> None:
    assert attempt_error(1) == 0.025
    assert attempt_error(3, levels=2) == 0.05 / 16
    assert sum(attempt_error(k) for k in range(1, 41)) < TOTAL_ERROR


def planned(seed: int = 1000, risks: tuple[float, ...] = (0.03,)) -> Attempt:
    return Attempt(
        number=1, bench="bench-v2", bench_sha256=BENCH, weights_sha256=WEIGHTS,
        method_sha256=method_sha256(METHOD), family="outlines", risks=risks, limit=0.01,
        scenes=3000, seed=seed, date=datetime(2026, 11, 26, tzinfo=UTC), sources="0.1.0+abc",
    )  # fmt: skip


def counts(attempt: Attempt, unsafe: int, risk: float = 0.03) -> ReleaseCounts:
    return ReleaseCounts.of(
        risk, attempt.error, scenes=3000, placed=2760 - unsafe, unsafe=unsafe, toppled=4
    )


def end(log: AttemptLog, attempt: Attempt, found: Sequence[ReleaseCounts]) -> Attempt:
    return log.append(log.closed(attempt, found))


def certified(folder: Path) -> tuple[ReleaseCertificate, Path]:
    log = AttemptLog(attempts_path(folder / "fused.safetensors"))
    begun = log.begin(planned())
    ended = end(log, begun, [counts(begun, 15)])
    found = certificate_of_attempt(ended, simulated=True, pieces=("pot", "barrel"))
    assert found is not None
    return found, write_certificate(folder, "fused", found)


def test_attempts_are_numbered_kept_and_spend_less_each_time(tmp_path: Path) -> None:
    log = AttemptLog(tmp_path / "fused.attempts.jsonl")
    first = log.begin(planned())
    assert log.begin(planned()) == first  # continued, not begun again
    end(log, first, [counts(first, 60)])
    second = log.begin(planned(seed=4000))
    assert (first.error, second.number, second.error) == (0.025, 2, 0.0125)
    assert [attempt.state for attempt in log.attempts()] == ["ended", "begun"]
    with pytest.raises(InputError, match="not the open one"):
        end(log, first, [counts(first, 0)])


@pytest.mark.parametrize("seed", [1000, 3999, 999])
def test_used_seeds_are_refused_also_after_a_failed_attempt(tmp_path: Path, seed: int) -> None:
    log = AttemptLog(tmp_path / "log")
    first = log.begin(planned())
    end(log, first, [counts(first, 60)])
    before = log.path.read_bytes()
    with pytest.raises(InputError, match=r"Attempt 1 of .* already used"):
        log.begin(planned(seed))
    assert log.path.read_bytes() == before


def test_used_trials_of_a_laboratory_are_refused(tmp_path: Path) -> None:
    log = AttemptLog(tmp_path / "log")
    own = planned().model_copy(update={"trials": ("run 1",), "seed": 0, "scenes": 1})
    log.begin(own)
    with pytest.raises(InputError, match="already used"):
        log.begin(own.model_copy(update={"trials": ("run 1", "run 2"), "scenes": 2}))


def test_removed_or_changed_lines_of_the_log_are_found(tmp_path: Path) -> None:
    log = AttemptLog(tmp_path / "log")
    first = log.begin(planned())
    end(log, first, [counts(first, 60)])
    log.begin(planned(seed=9000))
    lines = log.path.read_bytes().splitlines(keepends=True)
    for changed in (
        lines[1:],
        [lines[0], lines[2]],
        [lines[0].replace(b"3000", b"2000"), *lines[1:]],
    ):
        log.path.write_bytes(b"".join(changed))
        with pytest.raises(InputError):
            log.attempts()


def test_certificate_is_of_the_attempt_and_reads_back(tmp_path: Path) -> None:
    found, path = certified(tmp_path)
    assert read_certificate(path) == found
    assert found.counts.bound == pytest.approx(float(beta.ppf(0.975, 16, 2745)), rel=1e-9)
    assert found.summary() == "unsafe ≤ 0.9 % of releases (95 %), 15 of 2,760 on bench-v2"


def test_no_certificate_beyond_the_limit(tmp_path: Path) -> None:
    log = AttemptLog(tmp_path / "log")
    begun = log.begin(planned())
    ended = end(log, begun, [counts(begun, 30)])
    assert certificate_of_attempt(ended, simulated=True, pieces=("pot",)) is None


def test_of_several_levels_the_one_that_places_most_is_certified(tmp_path: Path) -> None:
    log = AttemptLog(tmp_path / "log")
    begun = log.begin(planned(risks=(0.01, 0.03)))
    careful = ReleaseCounts.of(0.01, begun.error, scenes=3000, placed=2500, unsafe=2, toppled=0)
    ended = end(log, begun, [careful, counts(begun, 12)])
    found = certificate_of_attempt(ended, simulated=True, pieces=("pot",))
    assert found is not None
    assert (found.risk, found.counts.error) == (0.03, 0.0125)


@pytest.mark.parametrize(
    ("key", "value"), [("bound", 0.005), ("unsafe", 1), ("error", 0.05), ("scenes", 10)]
)
def test_edited_counts_are_refused(tmp_path: Path, key: str, value: float) -> None:
    _, path = certified(tmp_path)
    content = json.loads(path.read_text())
    content["attempt"]["counts"][0][key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="cannot be used"):
        read_certificate(path)


CLAIM = ReleaseClaim("bench-v2", BENCH, WEIGHTS, METHOD, "pot", ("ring",), ())


def of_risk(risk: float, merge_mm: float = 0.0) -> StackSettings:
    fused = METHOD.fused.model_copy(update={"risk": risk, "merge_mm": merge_mm})
    return METHOD.model_copy(update={"fused": fused})


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        (
            {"bench_sha256": "c" * 64},
            "The present one is of bench-v2 with other settings, sensors or gels.",
        ),
        ({"weights_sha256": "c" * 64}, "None was made for this network."),
        ({"method": METHOD}, "It holds for a risk of 3 %, not of 10 %."),
        ({"method": of_risk(0.03, 0.5)}, "It holds for other settings of the method."),
        ({"piece": "mushroom"}, "It does not cover the piece 'mushroom'."),
        ({"bottoms": ("short", "long")}, "It does not cover towers."),
    ],
)
def test_certificate_of_something_else_is_not_used(
    tmp_path: Path, changed: dict[str, object], why: str
) -> None:
    found, _ = certified(tmp_path)
    claim = replace(CLAIM, method=of_risk(0.03), folders=(tmp_path,))
    assert find_certificate(claim).certificate == found
    status = find_certificate(replace(claim, **changed))  # type: ignore[arg-type]
    assert (status.certificate, status.text) == (None, "no certificate for this bench")
    assert status.scope == why


def test_without_a_file_or_with_a_damaged_one_there_is_no_certificate(tmp_path: Path) -> None:
    claim = replace(CLAIM, folders=(tmp_path,))
    assert find_certificate(claim).scope == "None was made."
    (tmp_path / "fused-x.certificate.json").write_text("{}")
    assert "cannot be used" in find_certificate(claim).scope
    assert find_certificate(claim).message.startswith("No certificate for this bench: the file")


def test_line_that_a_crash_cut_off_was_never_written(tmp_path: Path) -> None:
    log = AttemptLog(tmp_path / "log")
    first = log.begin(planned())
    whole = log.path.read_bytes()
    log.path.write_bytes(whole + whole[:100])
    assert log.attempts() == [first]
    end(log, first, [counts(first, 60)])
    assert log.path.read_bytes().startswith(whole)
    assert [attempt.state for attempt in log.attempts()] == ["ended"]
