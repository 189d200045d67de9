"""Presenter of the probe panel: one press here and now, phase by phase."""

from __future__ import annotations

from datetime import datetime

from app.activity import busy, why_no_run
from app.cards import refusal_card
from app.link import Link
from app.model_words import scene_words
from backend.config.method import ProbeSettings
from backend.core.facts import (
    EpisodeRecorded,
    Fact,
    PatchEstimated,
    PhaseEntered,
    RunFinished,
    RunStarted,
)
from backend.core.faults import InputError, RefusedError
from backend.runs.requests import ProbeRequest
from widgets.fault_cards import CardText, FaultCards
from widgets.probe_panel import ProbePanel

PHASES = ("grip", "reference", "approach", "press", "hold", "lift")


class ProbePresenter:
    """Starts a probe and tells how it went."""

    def __init__(self, link: Link, panel: ProbePanel, cards: FaultCards) -> None:
        self._link, self._panel, self._cards = link, panel, cards
        self._mine = False
        self._felt: list[str] = []
        self._piece, self._model = link.usual.piece, link.model
        panel.values.setText(values_text(ProbeSettings()))
        self.show_model()

    def start(self) -> None:
        """Probe once."""
        if busy(self._link):
            return
        try:
            self._link.start(ProbeRequest())
        except RefusedError as error:
            self._cards.show_card(refusal_card(error, f"{datetime.now():%H:%M:%S}"))
        except InputError as error:
            self._cards.show_card(
                CardText("INPUT", error.what, f"In {error.where}.", error.fix, reset=False)
            )

    def cancel(self) -> None:
        """End the probe in an orderly way."""
        if self._mine:
            self._link.engine.cancel()

    def show_model(self) -> None:
        """Say which model reads the next probe: that of the scene, if another was promoted."""
        words = scene_words(self._model, self._piece, simulated=self._link.simulated)
        self._panel.show_model(f"Model: {words.short}", words.full)

    def take(self, fact: Fact) -> None:
        """Follow the facts of a probe run."""
        if isinstance(fact, RunStarted):
            self._piece = fact.piece
            self._mine = fact.activity == "probe"
            self._felt = []
            if self._mine:
                self._panel.strip.show_phase(-1)
                self._panel.result.setText("Probing.")
        if not self._mine:
            return
        if isinstance(fact, PhaseEntered) and fact.phase in PHASES:
            self._panel.strip.show_phase(PHASES.index(fact.phase))
        elif isinstance(fact, EpisodeRecorded):
            self._note_episode(fact)
        elif isinstance(fact, PatchEstimated):
            share = float((fact.patch.probability > 0.5).mean())
            self._felt.append(f"contact on {100 * share:.0f} % of the face")
        elif isinstance(fact, RunFinished):
            self._end(fact)

    def draw(self) -> None:
        """Enable what is allowed now."""
        active = busy(self._link)
        why = "" if active else why_no_run(self._link)
        if active and not self._mine:
            why = "A run is going on"
        self._panel.show_buttons(
            probe=not active and not why, cancel=active and self._mine, why=why
        )
        if self._link.model is not self._model:
            self._model = self._link.model
            self.show_model()
        self._panel.detail.setText(self._link.status().phase if active and self._mine else "")

    def _note_episode(self, fact: EpisodeRecorded) -> None:
        episode = fact.episode
        self._felt.append(f"largest Fz {float(episode.observation[:, -4].max()):.1f} N")
        if not episode.quality.accepted:
            self._felt.append(f"not an observation: {'; '.join(episode.quality.reasons)}")

    def _end(self, fact: RunFinished) -> None:
        self._mine = False
        done = fact.ending == "finished"
        if done:
            self._panel.strip.show_phase(len(PHASES))
        felt = ", ".join(self._felt)
        told = f"{felt[:1].upper()}{felt[1:]}." if felt else ""
        self._panel.result.setText(told if done and told else f"{told} {fact.reason}".strip())


def values_text(probe: ProbeSettings) -> str:
    """Return the values of a probe in one line."""
    x, y, z = (f"{k:g}" for k in probe.stiffness_n_mm)
    return (
        f"{probe.depth_mm:g} mm deep, {probe.duration_s:g} s, stiffness {x} {y} {z} N/mm, "
        f"sampled at 10 Hz"
    )
