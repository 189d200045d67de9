"""Certificate of a network: exact bound of unsafe releases, its file, and the log of attempts.

Model and accepted risk are chosen first, on other scenes. The bound then comes from fresh
independent scenes at this single risk. Each attempt has scenes of its own and is written to an
append-only log before it runs. Attempt k = 1, 2, ... spends an error probability of 0.05 / 2^k,
divided by the number of risks that it tests (Bonferroni), so that all statements of one log hold
together with a probability of 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from touchdown.backend import config
from touchdown.backend.core import InputError, append_line, disk_errors, write_atomically

TOTAL_ERROR = 0.05  # error probability of all attempts of one log together
RISK_LIMIT = 0.01  # largest bound of a certificate of simulated scenes
CERTIFICATE_SUFFIX, ATTEMPTS_SUFFIX = ".certificate.json", ".attempts.jsonl"
MAX_BYTES = 2_000_000
LOG_FIX = "Restore the log of attempts from its repository."
UNWRITTEN_FIX = "Make room, or copy the model to a folder that can be written, and try again."
NO_CERTIFICATE = "no certificate for this bench"
LIMITS = "It covers no other shape, laboratory or robot by itself."
Count = Annotated[int, Field(ge=0)]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Date = Annotated[datetime, Field(strict=False)]


def risk_bound(unsafe: int, releases: int, error: float = TOTAL_ERROR) -> float:
    """Return the one-sided upper bound of the probability that a release is unsafe.

    Parameters
    ----------
    unsafe : int
        Number of unsafe releases.
    releases : int
        Number of independent releases.
    error : float, default: 0.05
        Probability that the bound is below the true value, at most.

    Returns
    -------
    float
        Upper bound of Clopper and Pearson (The use of confidence or fiducial limits, Biometrika
        26, 1934): the probability p at which ``unsafe`` or fewer events have the probability
        ``error``. 1 without a safe release.

    Examples
    --------
    >>> [round(risk_bound(k, n), 3) for k, n in ((0, 299), (1, 473), (4, 914), (18, 2760))]
    [0.01, 0.01, 0.01, 0.01]

    """
    if not 0 <= unsafe <= releases or not 0.0 < error < 1.0:
        raise ValueError("counts or error probability out of range")
    if unsafe == releases:
        return 1.0
    # Imported here: the window reads certificates seldom.
    from scipy.special import betainccinv

    return float(betainccinv(unsafe + 1, releases - unsafe, error))


def releases_needed(limit: float, error: float = TOTAL_ERROR) -> int:
    """Return the number of releases, none of them unsafe, whose bound is ``limit``."""
    return math.ceil(math.log(error) / math.log1p(-limit))


def attempt_error(number: int, levels: int = 1) -> float:
    """Return the error probability of each risk tested in attempt 1, 2, ...

    The errors of all attempts add up to 0.05 (union bound); so do the levels of one attempt
    (Bonferroni; Holm, A simple sequentially rejective multiple test procedure, 1979).
    """
    return float(TOTAL_ERROR / 2.0**number / levels)


def method_sha256(method: config.StackSettings) -> str:
    """Return the hash of the settings that shape a release of ``fused``, without file and risk."""
    content = method.model_dump(mode="json", include={"probe", "policy", "fused", "release"})
    for name in ("weights", "risk"):
        del content["fused"][name]
    if not method.release.stages:  # the others have no effect then
        for name in ("stages", "stage_mm", "turn_sigmas", "lean_sigmas", "regrasp_sigma_mm"):
            del content["release"][name]
    return config.sha256_of_json(content)


class ReleaseCounts(config.Settings):
    """Outcomes of the scenes at one risk, and the bound of the unsafe among the releases.

    ``harmed``: unsafe releases and pieces knocked over before.
    """

    risk: config.Probability
    scenes: Count
    releases: Count
    unsafe: Count
    placed: Count
    harmed: Count
    error: config.Probability
    bound: Annotated[float, Field(gt=0, le=1)]

    @classmethod
    def of(
        cls, risk: float, error: float, *, scenes: int, placed: int, unsafe: int, toppled: int
    ) -> Self:
        """Return the counts with their bound."""
        return cls(
            risk=risk,
            scenes=scenes,
            releases=placed + unsafe,
            unsafe=unsafe,
            placed=placed,
            harmed=unsafe + toppled,
            error=error,
            bound=risk_bound(unsafe, placed + unsafe, error),
        )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.releases != self.placed + self.unsafe or self.harmed < self.unsafe:
            raise ValueError("the counts contradict each other")
        if self.scenes < self.placed + self.harmed:
            raise ValueError("there are more outcomes than scenes")
        found = risk_bound(self.unsafe, self.releases, self.error)
        if not math.isclose(found, self.bound, rel_tol=1e-6):
            raise ValueError(f"the bound of these counts is {found:.6f}")
        return self


class Attempt(config.Settings):
    """Line of the log: an attempt that began, or the same one with its counts.

    ``seed``: first one of ``scenes`` seeds for each of ``risks``; 0 where trials are named in
    ``trials``. ``previous``: SHA-256 of all lines before.
    """

    format: Literal["touchdown-attempts/1"] = "touchdown-attempts/1"
    state: Literal["begun", "ended"] = "begun"
    number: Annotated[int, Field(ge=1, le=40)]
    bench: str
    bench_sha256: Digest
    weights_sha256: Digest
    method_sha256: Digest
    family: str
    risks: Annotated[tuple[config.Probability, ...], Field(min_length=1)]
    limit: config.Probability
    scenes: Annotated[int, Field(ge=1)]
    seed: Count = 0
    trials: tuple[str, ...] = ()
    date: Date
    sources: str = ""
    program_version: str = ""
    counts: tuple[ReleaseCounts, ...] = ()
    previous: Digest = sha256(b"").hexdigest()

    @property
    def error(self) -> float:
        """Error probability of each risk."""
        return attempt_error(self.number, len(self.risks))

    def seeds(self) -> range:
        """Return all seeds of the attempt."""
        return range(self.seed, self.seed + (0 if self.trials else self.scenes * len(self.risks)))

    def plan(self) -> dict[str, object]:
        """Return everything that was fixed before the attempt ran, without its number and seed."""
        outside = {"state", "number", "seed", "date", "counts", "previous", "program_version"}
        return self.model_dump(mode="json", exclude=outside)


class AttemptLog:
    """Append-only log of the attempts beside a checkpoint.

    Each line names the hash of those before it.

    Parameters
    ----------
    path : Path
        File in JSON lines; it may not exist yet.

    """

    def __init__(self, path: Path) -> None:
        self.path: Path = path

    def attempts(self) -> list[Attempt]:
        """Return the attempts in order, ended ones with their counts.

        Raises
        ------
        InputError
            If a line is damaged, or was changed or removed after it was written.

        """
        found: dict[int, Attempt] = {}
        before = b""
        for at, raw in enumerate(self._content().splitlines(keepends=True), start=1):
            where = f"{self.path}, line {at}"
            try:
                line = Attempt.model_validate_json(raw)
            except ValidationError as error:
                raise _bad_log(
                    where, f"The line is damaged: {config.first_error(error)}"
                ) from error
            if line.previous != sha256(before).hexdigest():
                raise _bad_log(where, "A line before this one was changed or removed")
            begun = found.get(line.number)
            new = line.state == "begun" and line.number == len(found) + 1
            if not new and (begun is None or begun.state == line.state or line.state == "begun"):
                raise _bad_log(where, "The numbers of the attempts are out of order")
            found[line.number] = line
            before += raw
        return list(found.values())

    def begin(self, planned: Attempt) -> Attempt:
        """Write a new attempt before it runs, and return it with its number.

        An attempt that began with the same plan and has no counts yet is continued instead.

        Raises
        ------
        InputError
            If a seed or a trial was used by an earlier attempt, or the log cannot be written.

        """
        attempts = self.attempts()
        if attempts and attempts[-1].state == "begun" and attempts[-1].plan() == planned.plan():
            return attempts[-1]
        new = planned.model_copy(update={"number": len(attempts) + 1, "state": "begun"})
        for old in attempts:
            if set(new.trials) & set(old.trials) or set(new.seeds()) & set(old.seeds()):
                raise InputError(
                    f"Attempt {old.number} of {old.date:%Y-%m-%d} already used some of these "
                    "scenes; a second look at them would not be independent.",
                    str(self.path),
                    "Use fresh seeds, or new trials.",
                )
        return self.append(self._next_line(new))

    def closed(self, attempt: Attempt, counts: Sequence[ReleaseCounts]) -> Attempt:
        """Return the open attempt with its counts, for ``append``; raises ``InputError``."""
        last = self.attempts()[-1]
        if last.state == "ended" or last.number != attempt.number:
            raise _bad_log(str(self.path), "The attempt is not the open one")
        return self._next_line(last.model_copy(update={"state": "ended", "counts": tuple(counts)}))

    def _next_line(self, line: Attempt) -> Attempt:
        previous = sha256(self._content()).hexdigest()
        update = {"previous": previous, "date": datetime.now(UTC).replace(microsecond=0)}
        return Attempt.model_validate(line.model_copy(update=update).model_dump())

    def append(self, line: Attempt) -> Attempt:
        """Write a line and return it; raises ``InputError``."""
        with disk_errors("The attempt cannot be written", self.path, UNWRITTEN_FIX):
            append_line(self.path, line.model_dump_json().encode())
        return line

    def _content(self) -> bytes:
        with disk_errors("It cannot be read", self.path, LOG_FIX):
            content = self.path.read_bytes() if self.path.exists() else b""
        return content[: content.rfind(b"\n") + 1]


def _bad_log(where: str, what: str) -> InputError:
    return InputError(f"{what}.", where, LOG_FIX)


class ReleaseCertificate(config.Settings):
    """File beside a checkpoint: the attempt that bounds the unsafe releases at one ``risk``.

    ``pieces`` and ``bottoms`` are the covered names; no bottoms: any of the family.
    """

    format: Literal["touchdown-certificate/1"] = "touchdown-certificate/1"
    attempt: Attempt
    risk: config.Probability
    simulated: bool
    pieces: tuple[str, ...]
    bottoms: tuple[str, ...] = ()

    @property
    def counts(self) -> ReleaseCounts:
        """Counts at the risk."""
        return next(counts for counts in self.attempt.counts if counts.risk == self.risk)

    @model_validator(mode="after")
    def _holds(self) -> Self:
        if self.risk not in [counts.risk for counts in self.attempt.counts]:
            raise ValueError("it has no counts at its risk")
        if self.counts.bound > self.attempt.limit:
            raise ValueError(f"the bound {self.counts.bound:.4f} exceeds {self.attempt.limit:g}")
        if not math.isclose(self.counts.error, self.attempt.error):
            raise ValueError("the error probability is not that of the attempt")
        return self

    def summary(self) -> str:
        """Return the statement in words; the bound is rounded up to a tenth of a percent."""
        counts = self.counts
        bound = math.ceil(1000.0 * counts.bound - 1e-9) / 10.0
        return (
            f"unsafe \N{LESS-THAN OR EQUAL TO} {bound:.1f} % of releases (95 %), "
            f"{counts.unsafe:,} of {counts.releases:,} on {self.attempt.bench}"
        )


def certificate_of_attempt(
    attempt: Attempt, *, simulated: bool, pieces: Iterable[str], bottoms: Iterable[str] = ()
) -> ReleaseCertificate | None:
    """Return the certificate of the tested risk with the most placed scenes; None if none holds."""
    good = [counts for counts in attempt.counts if counts.bound <= attempt.limit]
    if not good:
        return None
    return ReleaseCertificate(
        attempt=attempt,
        risk=max(good, key=lambda counts: counts.placed).risk,
        simulated=simulated,
        pieces=tuple(pieces),
        bottoms=tuple(bottoms),
    )


def attempts_path(weights: Path) -> Path:
    """Return the log of attempts beside a checkpoint."""
    return weights.with_name(weights.stem + ATTEMPTS_SUFFIX)


def write_certificate(folder: Path, name: str, certificate: ReleaseCertificate) -> Path:
    """Write ``<name>-<bench>.certificate.json`` to ``folder`` and return its path."""
    path = folder / f"{name}-{certificate.attempt.bench_sha256[:12]}{CERTIFICATE_SUFFIX}"
    write_atomically(path, certificate.model_dump_json(indent=1).encode() + b"\n")
    return path


def read_certificate(path: Path) -> ReleaseCertificate:
    """Read a certificate and check its bound; raises ``InputError`` for a damaged file."""
    return config.read_json_model(ReleaseCertificate, path, MAX_BYTES, "Certify the model again.")


@dataclass(frozen=True, slots=True)
class ReleaseClaim:
    """A run for which a certificate is wanted.

    ``bench``, ``bench_sha256``: name and hash of the bench, "" without one of its own. ``folders``:
    where certificates may lie.
    """

    bench: str
    bench_sha256: str
    weights_sha256: str
    method: config.StackSettings
    piece: str
    bottoms: tuple[str, ...]
    folders: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class CertificateStatus:
    """Certificate of a run, or the ``reason`` why there is none, as the end of a sentence."""

    certificate: ReleaseCertificate | None
    reason: str = ""

    @property
    def text(self) -> str:
        """Statement for the operator."""
        return NO_CERTIFICATE if self.certificate is None else self.certificate.summary()

    @property
    def scope(self) -> str:
        """Range of the statement, or the reason for its absence."""
        if self.certificate is None:
            return f"{self.reason[:1].upper()}{self.reason[1:]}."
        return (
            f"For {', '.join(self.certificate.pieces)} on {self.certificate.attempt.family}, at a "
            f"risk of {100 * self.certificate.risk:g} %."
        )

    @property
    def message(self) -> str:
        """Statement and its limits, or the reason why there is none."""
        text = f"{self.text[:1].upper()}{self.text[1:]}"
        return f"{text}: {self.reason}." if self.certificate is None else f"{text}. {LIMITS}"


def find_certificate(claim: ReleaseClaim) -> CertificateStatus:
    """Return the certificate that covers a run; else the reason of the one that comes nearest."""
    nearest = (-1, "none was made")
    for folder in claim.folders:
        for path in sorted(folder.glob(f"*{CERTIFICATE_SUFFIX}")):
            try:
                certificate = read_certificate(path)
            except InputError as error:
                nearest = max(nearest, (0, error.what[:1].lower() + error.what[1:].rstrip(".")))
                continue
            passed, why = _mismatch(certificate, claim)
            if not why:
                return CertificateStatus(certificate)
            nearest = max(nearest, (passed, why))
    return CertificateStatus(None, nearest[1])


def _mismatch(certificate: ReleaseCertificate, claim: ReleaseClaim) -> tuple[int, str]:
    """Return the number of conditions that hold, and the first that does not, or ""."""
    found, own, wanted = certificate.attempt, certificate.risk, claim.method.fused.risk
    bottoms, settings = certificate.bottoms, method_sha256(claim.method)
    changed = " with other settings, sensors or gels" if found.bench == claim.bench else ""
    conditions = (
        (found.weights_sha256 == claim.weights_sha256, "none was made for this network"),
        (found.bench_sha256 == claim.bench_sha256, f"the present one is of {found.bench}{changed}"),
        (own == wanted, f"it holds for a risk of {100 * own:g} %, not of {100 * wanted:g} %"),
        (found.method_sha256 == settings, "it holds for other settings of the method"),
        (claim.piece in certificate.pieces, f"it does not cover the piece '{claim.piece}'"),
        (len(claim.bottoms) == 1, "it does not cover towers"),
        (
            not bottoms or claim.bottoms[-1] in bottoms,
            f"it does not cover the bottom '{claim.bottoms[-1]}'",
        ),
    )
    for passed, (holds, why) in enumerate(conditions, start=1):
        if not holds:
            return passed, why
    return len(conditions), ""
