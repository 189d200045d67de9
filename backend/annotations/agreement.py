"""Agreement between labellers: bias and limits, ICC, kappa, alpha, patch overlap."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import permutations
from statistics import fmean, median

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.geometry_records import GeometryStore
from touchdown.backend.annotations.values import Label, Verdict

LIMITS = 1.96
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AgreementLimits:
    """Mean difference of two raters, its standard deviation (n - 1) and 95 % limits."""

    mean: float
    deviation: float
    lower: float
    upper: float


def agreement_limits(first: ArrayLike, second: ArrayLike) -> AgreementLimits:
    """Return bias and 95 % limits of agreement of ``first`` minus ``second``, (n,) each."""
    d = np.asarray(first, dtype=np.float64) - np.asarray(second, dtype=np.float64)
    mean = float(d.mean()) if d.size else math.nan
    deviation = float(d.std(ddof=1)) if d.size > 1 else math.nan
    half = LIMITS * deviation
    return AgreementLimits(mean, deviation, mean - half, mean + half)


def intraclass_correlation(ratings: ArrayLike) -> float:
    """Return ICC(2,1) of ``ratings`` (n, k): two-way random effects, absolute agreement."""
    x = np.asarray(ratings, dtype=np.float64)
    n, k = x.shape
    if n < 2 or k < 2:
        return math.nan
    rows, columns, grand = x.mean(axis=1), x.mean(axis=0), x.mean()
    between_rows = k * float(((rows - grand) ** 2).sum()) / (n - 1)
    between_columns = n * float(((columns - grand) ** 2).sum()) / (k - 1)
    left = x - rows[:, None] - columns[None, :] + grand
    error = float((left**2).sum()) / ((n - 1) * (k - 1))
    spread = between_rows + (k - 1) * error + k * (between_columns - error) / n
    return (between_rows - error) / spread if spread else math.nan


def cohen_kappa(first: Sequence[Hashable], second: Sequence[Hashable]) -> float:
    """Return Cohen's kappa of two raters who classified the same n items."""
    n = len(first)
    if not n or n != len(second):
        return math.nan
    observed = sum(a == b for a, b in zip(first, second, strict=True)) / n
    one, two = Counter(first), Counter(second)
    expected = sum(one[word] * two[word] for word in one) / n**2
    return (observed - expected) / (1 - expected) if expected < 1 else math.nan


def krippendorff_alpha(items: Sequence[Sequence[Hashable]]) -> float:
    """Return nominal Krippendorff's alpha; each item holds the answers of its raters."""
    pairs: Counter[tuple[Hashable, Hashable]] = Counter()
    for answers in items:
        for pair in permutations(answers, 2):
            pairs[pair] += 1 / (len(answers) - 1)  # type: ignore[assignment]
    values: Counter[Hashable] = Counter()
    for (a, _), weight in pairs.items():
        values[a] += weight
    n = sum(values.values())
    if n <= 1:
        return math.nan
    observed = sum(weight for (a, b), weight in pairs.items() if a != b) / n
    expected = 1 - sum(count * (count - 1) for count in values.values()) / (n * (n - 1))
    return 1 - observed / expected if expected else math.nan


def rms_mm(first_mm: ArrayLike, second_mm: ArrayLike) -> float:
    """Return the root mean square distance of two sets of offsets (n, 2)."""
    d = np.asarray(first_mm, dtype=np.float64) - np.asarray(second_mm, dtype=np.float64)
    return float(np.sqrt((d**2).sum(axis=-1).mean())) if d.size else math.nan


def patch_iou(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Return the intersection over union of two patches (N,); 1 if both are empty."""
    either = int(np.sum(first | second))
    return float(np.sum(first & second)) / either if either else 1.0


PAUSE_MS = 60_000  # times above this count as a pause and are clipped


@dataclass(frozen=True, slots=True)
class LabellerAnswer:
    """Latest answer of one person for one episode."""

    episode: str
    geometry: str
    label: Label
    verdict: Verdict | None
    seen_ms: int | None
    blind: bool
    at_ns: int = 0


@dataclass(frozen=True, slots=True)
class AgreementReport:
    """Agreement of two persons, first minus second; NaN where the data do not suffice.

    ``drift_mm`` (x, y): mean difference in the second half of the episodes minus that in the first.
    ``seconds``: median time per answer of each person, where it was measured. ``periods``: name,
    number of episodes and RMS distance in mm of each day, ISO week or month, oldest first.
    """

    episodes: int
    bias_x_mm: AgreementLimits
    bias_y_mm: AgreementLimits
    rms_mm: float
    icc_x: float
    icc_y: float
    patch_iou: float
    kappa: float
    alpha: float
    drift_mm: tuple[float, float]
    seconds: tuple[float, float]
    periods: tuple[tuple[str, int, float], ...]


@dataclass(frozen=True, slots=True)
class SuggestionBias:
    """Effect of a visible suggestion: blind answers minus answers with the suggestion shown."""

    episodes: int
    x_mm: AgreementLimits
    y_mm: AgreementLimits


def suggestion_bias(database: Database, people: Sequence[str]) -> SuggestionBias:
    """Return the bias over the episodes that were answered both blind and with a suggestion."""
    blind, shown = (
        {
            uuid: answer.label
            for person in people
            for uuid, answer in read_answers(database, person, blind=kind).items()
            if answer.label.is_set
        }
        for kind in (True, False)
    )
    both = [uuid for uuid in blind if uuid in shown]
    a, b = _offsets_mm(blind[u] for u in both), _offsets_mm(shown[u] for u in both)
    return SuggestionBias(
        len(both), agreement_limits(a[:, 0], b[:, 0]), agreement_limits(a[:, 1], b[:, 1])
    )


def _offsets_mm(labels: Iterable[Label]) -> Floats:
    return np.array([label.offset_mm for label in labels], dtype=np.float64).reshape(-1, 2)


def read_answers(
    database: Database, person: str, *, blind: bool | None = None
) -> dict[str, LabellerAnswer]:
    """Return the latest answer of ``person`` for each episode: set, accepted, or an opinion.

    ``blind``: only answers given without (True) or with (False) a suggestion in sight.
    """
    sql = """
    SELECT episode, geometry, x_um, y_um, theta_mdeg, sigma_um, verdict,
        json_extract(body, '$.seen_ms'), json_extract(body, '$.blind'), at_ns
    FROM (
        SELECT r.episode, r.geometry, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um, r.verdict, o.body,
            o.lamport, o.seq, o.at_ns FROM op o JOIN label_rev r USING (op_uuid)
        WHERE o.actor = ? AND o.verb IN ('label.set', 'label.accept_next')
        UNION ALL
        SELECT p.episode, h.geometry, p.x_um, p.y_um, p.theta_mdeg, p.sigma_um, p.verdict, o.body,
            o.lamport, o.seq, o.at_ns FROM op o JOIN opinion p USING (op_uuid)
        JOIN label_head l ON l.episode = p.episode JOIN label_rev h ON h.rev_uuid = l.rev_uuid
        WHERE o.actor = ?
    ) ORDER BY lamport, seq
    """
    found: dict[str, LabellerAnswer] = {}
    for row in database.rows(sql, (person, person)):
        episode, geometry, *label, verdict, seen_ms, hidden, at_ns = row
        if blind is not None and (hidden is None or bool(hidden) is not blind):
            continue
        # The latest answer counts and determines the order.
        found.pop(episode, None)
        found[episode] = LabellerAnswer(
            episode, geometry, Label(*label), verdict, seen_ms, bool(hidden), at_ns
        )
    return found


def compare_labellers(
    database: Database, geometry: GeometryStore, first: str, second: str
) -> AgreementReport:
    """Return the agreement of two persons."""
    return _agreement(geometry, read_answers(database, first), read_answers(database, second))


def compare_with_control_items(
    database: Database, geometry: GeometryStore, person: str
) -> AgreementReport:
    """Compare the opinions of ``person`` with the approved labels of the same episodes.

    Times are known for the person only. An opinion without offset counts as an episode and enters
    no other figure.
    """
    sql = """
    SELECT p.episode, r.geometry, p.x_um, p.y_um, p.theta_mdeg, p.sigma_um, p.verdict,
        json_extract(o.body, '$.seen_ms'), o.at_ns, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um,
        r.verdict
    FROM opinion p JOIN op o USING (op_uuid) JOIN label_head h ON h.episode = p.episode
    JOIN label_rev r ON r.rev_uuid = h.counting
    WHERE o.actor = ? AND instr(h.authors, ?) = 0 ORDER BY o.lamport, o.seq
    """
    given, approved_labels = dict[str, LabellerAnswer](), dict[str, LabellerAnswer]()
    for row in database.rows(sql, (person, f"\n{person}\n")):
        episode, record, *label, verdict, seen_ms, at_ns, x, y, theta, sigma, approved = row
        # The latest answer counts and determines the order.
        given.pop(episode, None)
        given[episode] = LabellerAnswer(
            episode, record, Label(*label), verdict, seen_ms, blind=True, at_ns=at_ns
        )
        approved_labels[episode] = LabellerAnswer(
            episode, record, Label(x, y, theta, sigma), approved, None, False
        )
    return _agreement(geometry, given, approved_labels)


def _agreement(
    geometry: GeometryStore, one: dict[str, LabellerAnswer], two: dict[str, LabellerAnswer]
) -> AgreementReport:
    both = [uuid for uuid in one if uuid in two]
    pairs = [(one[u], two[u]) for u in both if one[u].label.is_set and two[u].label.is_set]
    a, b = _offsets_mm(x.label for x, _ in pairs), _offsets_mm(y.label for _, y in pairs)
    verdicts = [(one[u].verdict, two[u].verdict) for u in both]
    named = [(x, y) for x, y in verdicts if x is not None and y is not None]
    overlaps = [
        patch_iou(*(geometry.patch(y.geometry, answer.label).touching for answer in (x, y)))
        for x, y in pairs
    ]
    half, d = len(pairs) // 2, a - b
    drift_x, drift_y = math.nan, math.nan
    if half:
        drift_x, drift_y = (d[half:].mean(axis=0) - d[:half].mean(axis=0)).tolist()
    return AgreementReport(
        episodes=len(both),
        bias_x_mm=agreement_limits(a[:, 0], b[:, 0]),
        bias_y_mm=agreement_limits(a[:, 1], b[:, 1]),
        rms_mm=rms_mm(a, b),
        icc_x=intraclass_correlation(np.stack([a[:, 0], b[:, 0]], axis=1)),
        icc_y=intraclass_correlation(np.stack([a[:, 1], b[:, 1]], axis=1)),
        patch_iou=fmean(overlaps) if overlaps else math.nan,
        kappa=cohen_kappa([x for x, _ in named], [y for _, y in named]),
        alpha=krippendorff_alpha(named),
        drift_mm=(drift_x, drift_y),
        seconds=(_seconds(one), _seconds(two)),
        periods=_periods([max(x.at_ns, y.at_ns) for x, y in pairs], d),
    )


# Name of the periods of up to so many days
PERIODS = ((15, "%Y-%m-%d"), (100, "%G-W%V"), (math.inf, "%Y-%m"))


def _periods(times_ns: Sequence[int], d: Floats) -> tuple[tuple[str, int, float], ...]:
    """Return the differences ``d`` (n, 2) by day, week or month, after their whole duration."""
    days = (max(times_ns) - min(times_ns)) / 86_400e9 if times_ns else 0
    form = next(form for most, form in PERIODS if days < most)
    names = np.array([f"{datetime.fromtimestamp(t / 1e9):{form}}" for t in times_ns])
    parts = {str(name): d[names == name] for name in np.unique(names)}
    return tuple((name, len(part), rms_mm(part, 0 * part)) for name, part in parts.items())


def _seconds(given: dict[str, LabellerAnswer]) -> float:
    times = [min(a.seen_ms, PAUSE_MS) / 1e3 for a in given.values() if a.seen_ms is not None]
    return median(times) if times else math.nan
