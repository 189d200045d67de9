"""Operate workspace."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime

from touchdown.app.operate.jogging import PACES, ROWS, JogKeyFilter, ManualControlPresenter
from touchdown.app.operate.page import OperatePage
from touchdown.app.shell import (
    LivePresenter,
    LiveViews,
    Memory,
    RunStory,
    WindowCommand,
    Workspace,
    WorkspaceContext,
    belief_scene,
    face_outlines,
    is_run_active,
    refusal_card,
    scene_model_caption,
    start_obstacle,
    unprobed_scene,
)
from touchdown.backend.bench import Session
from touchdown.backend.config import ProbeSettings
from touchdown.backend.core import (
    EpisodeRecorded,
    Event,
    InputError,
    PatchEstimated,
    PhaseEntered,
    RefusedError,
    RunFinished,
    RunStarted,
)
from touchdown.backend.runs import ProbeRequest
from touchdown.widgets.forms import ProbePanel
from touchdown.widgets.shell import CardText, FaultCards
from touchdown.widgets.views import BeliefScene

PHASES = ("grip", "reference", "approach", "press", "hold", "lift")


class SingleProbePresenter:
    """Starts a probe and tells how it went."""

    def __init__(self, bench: Session, panel: ProbePanel, cards: FaultCards) -> None:
        self._bench, self._panel, self._cards = bench, panel, cards
        self._mine = False
        self._felt: list[str] = []
        self._piece, self._model = bench.usual.piece, bench.model
        panel.values.setText(values_text(ProbeSettings()))
        self.show_model()

    def start(self) -> None:
        """Probe once."""
        if is_run_active(self._bench):
            return
        try:
            self._bench.start(ProbeRequest())
        except RefusedError as error:
            self._cards.show_card(refusal_card(error, f"{datetime.now():%H:%M:%S}"))
        except InputError as error:
            self._cards.show_card(
                CardText("INPUT", error.what, f"In {error.where}.", error.fix, reset=False)
            )

    def cancel(self) -> None:
        """End the probe in an orderly way."""
        if self._mine:
            self._bench.engine.cancel()

    def show_model(self) -> None:
        """Say which model reads the next probe: that of the scene, if another was promoted."""
        words = scene_model_caption(self._model, self._piece, simulated=self._bench.simulated)
        self._panel.show_model(f"Model: {words.short}", words.full)

    def take(self, fact: Event) -> None:
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
        active = is_run_active(self._bench)
        why = "" if active else start_obstacle(self._bench)
        if active and not self._mine:
            why = "A run is going on"
        self._panel.show_buttons(
            probe=not active and not why, cancel=active and self._mine, why=why
        )
        if self._bench.model is not self._model:
            self._model = self._bench.model
            self.show_model()
        self._panel.detail.setText(self._bench.status().phase if active and self._mine else "")

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


NO_RUN = BeliefScene(
    empty=("No stacking run yet", "The map is fused over a run; one probe alone makes none.")
)


class OperateWorkspace(Workspace):
    """Live views, belief of the last run, probe once, jog and gripper."""

    name, title, key = "operate", "Operate", "Ctrl+1"
    held_keys = ROWS
    page: OperatePage

    def __init__(self, desk: WorkspaceContext) -> None:
        self._desk = desk
        self.live: LivePresenter | None = None
        self.hand: ManualControlPresenter | None = None
        self.probe: SingleProbePresenter | None = None
        self._bench: Session | None = None
        self._story, self._shown = RunStory(), -1
        self.commands = self._commands()

    def build(self) -> Iterator[None]:
        """Make the page."""
        self.page = page = OperatePage(self._desk.theme)
        yield
        yield from page.build(PACES, PHASES, self._renew)
        page.jog.hold_ended.connect(self._ended)
        page.jog.step_pressed.connect(self._step)
        page.jog.keys_toggled.connect(self._arm_keys)
        page.jog.level_requested.connect(self._level)
        page.grip_requested.connect(self._grip)
        page.open_requested.connect(self._open)
        page.probe_requested.connect(self._probe)
        page.cancel_requested.connect(self._cancel)
        page.zero_requested.connect(self._zero)
        page.baseline_requested.connect(self._baseline)
        page.span_chosen.connect(self._span)
        page.pause_toggled.connect(self._pause)
        page.scene_chosen.connect(self._set_scene)
        self.page.belief.show_scene(NO_RUN)
        self.columns = self.pieces = self.page.columns
        self.keys = JogKeyFilter(self.page, self.page.jog)

    def attach(self, bench: Session) -> None:
        """Show this bench."""
        page = self.page
        self._bench = bench
        views = LiveViews(page.tactile, page.captions, page.force, page.moment)
        self.live = LivePresenter(bench, views)
        self.hand = ManualControlPresenter(bench, page, self._desk.cards)
        self.probe = SingleProbePresenter(bench, page.probe, self._desk.cards)
        self.parts = (
            self.live.draw_left, self.live.draw_right, self.live.draw_wrench,
            self.live.draw_headers, self.hand.draw, self.probe.draw, self._draw_belief,
        )  # fmt: skip

    def take(self, fact: Event) -> None:
        """Follow the runs."""
        self._story.take(fact)
        if self.probe is not None:
            self.probe.take(fact)

    def show_waiting(self, word: str, why: str) -> None:
        """Say why there is no bench yet."""
        self.page.show_waiting(why)

    def enter(self) -> None:
        """Another model may have been put in use meanwhile."""
        if self.probe is not None:
            self.probe.show_model()

    def leave(self) -> None:
        """Nothing moves by hand on a page that is not seen."""
        self.page.jog.hold.end("another page came to the front")
        self.keys.disarm()

    def fit_to_theme(self) -> None:
        """Take the sizes of the theme."""
        self.page.fit_to_theme()

    def reset_layout(self) -> None:
        """Choose the first entry everywhere."""
        for chooser in (self.page.looks, self.page.span, self.page.maps):
            chooser.setCurrentIndex(0)

    def memory(self) -> Memory:
        """Return what was chosen."""
        page = self.page
        return {
            "look": page.looks.currentIndex(),
            "span": page.span.currentIndex(),
            "map": page.maps.currentIndex(),
            "grip_n": page.gripper.force.value(),
        }

    def recall(self, memory: Memory) -> Sequence[str]:
        """Choose again what was chosen."""
        dropped, page = [], self.page
        for name, chooser in (("look", page.looks), ("span", page.span), ("map", page.maps)):
            index = memory.get(name, 0)
            if type(index) is int and 0 <= index < chooser.count():
                chooser.setCurrentIndex(index)
            else:
                dropped.append(name)
        grip_n = memory.get("grip_n", page.gripper.force.value())
        if isinstance(grip_n, float):
            page.gripper.force.setValue(grip_n)
        else:
            dropped.append("grip_n")
        return dropped

    def close(self) -> None:
        """Let go."""
        self.leave()

    # -- orders -----------------------------------------------------------------------------------

    def _commands(self) -> tuple[WindowCommand, ...]:
        return (
            WindowCommand("probe", "Probe once", "F5", self._probe),
            WindowCommand("grip", "Grip the piece", "G", self._grip),
            WindowCommand("open", "Open the gripper", "Shift+G", self._open),
            WindowCommand("zero", "Zero force and moment", "Z", self._zero),
            WindowCommand("baseline", "Take the tactile reference anew", "B", self._baseline),
            WindowCommand(
                "arm", "Arm or disarm the jog keys", "J", lambda: self.page.jog.keys.toggle()
            ),
            WindowCommand(
                "shorter",
                "Shorter step, down to hold-to-run",
                "[",
                lambda: self.page.jog.next_step(-1),
            ),
            WindowCommand("longer", "Longer step", "]", lambda: self.page.jog.next_step(1)),
            WindowCommand(
                "frame",
                "Jog in the next frame: XYZ, TOOL, JOINT",
                "F",
                lambda: self.page.jog.next_frame(),
            ),
            WindowCommand(
                "turn", "Jog: turn the hand, or move it", "T", lambda: self.page.jog.turn.click()
            ),
            WindowCommand("level", "Level the hand", "Shift+T", self._level),
            WindowCommand(
                "scene", "Set the simulated bench anew", "Ctrl+N", lambda: self.page.scene.ask()
            ),
            WindowCommand(
                "freeze", "Hold the traces still", "Ctrl+P", lambda: self.page.pause.toggle()
            ),
            WindowCommand(
                "fit", "Fit the force and moment ranges", "Ctrl+F", lambda: self.page.fit()
            ),
        )

    def _renew(self, what: str) -> bool:
        return self.hand is not None and self.hand.renew(what)

    def _ended(self, cause: str) -> None:
        if self.hand is not None:
            self.hand.ended(cause)

    def _step(self, what: str) -> None:
        if self.hand is not None:
            self.hand.step(what)

    def _level(self) -> None:
        if self.hand is not None:
            self.hand.level()

    def _arm_keys(self, on: bool) -> None:
        self.keys.arm(on and self.hand is not None and not self.hand.why_not())
        self.page.jog.show_armed(self.keys.armed)

    def _grip(self) -> None:
        if self.hand is not None:
            self.hand.grip()

    def _open(self) -> None:
        if self.hand is not None:
            self.hand.open()

    def _probe(self) -> None:
        if self.probe is not None:
            self.probe.start()

    def _cancel(self) -> None:
        if self.probe is not None:
            self.probe.cancel()

    def _zero(self) -> None:
        if self.hand is not None:
            self.hand.zero()

    def _baseline(self) -> None:
        if self.hand is not None:
            self.hand.baseline()

    def _set_scene(self, piece: str, bottom: str) -> None:
        if self.hand is not None and self.page.scene.set.isEnabled():
            self.hand.set_scene(piece, bottom)

    def _span(self, span_s: float) -> None:
        if self.live is not None:
            self.live.show_span(span_s)

    def _pause(self, paused: bool) -> None:
        if self.live is not None:
            self.live.paused = paused

    def _draw_belief(self) -> None:
        if self._shown == self._story.version or self._bench is None:
            return
        self._shown, trial = self._story.version, self._story.trial
        if trial is None or not trial.probes:
            self.page.belief.show_scene(NO_RUN if trial is None else unprobed_scene(trial))
            self.page.belief_panel.detail.setText("")
            return
        face, bottom = face_outlines(self._bench.catalogue, self._story.head)
        scene = belief_scene(trial, len(trial.probes) - 1, face, bottom)
        self.page.belief.show_scene(scene)
        self.page.legend.show_truth(scene.truth is not None)
        self.page.belief_panel.detail.setText(f"trial {trial.trial}, probe {len(trial.probes)}")
