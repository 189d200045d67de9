"""Operate workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field

from touchdown.app import shell
from touchdown.app.operate.jogging import PACES, ROWS, JogKeyFilter, ManualControlPresenter
from touchdown.app.operate.page import OperatePage
from touchdown.backend import core
from touchdown.backend.bench import Session
from touchdown.backend.config import ProbeSettings
from touchdown.backend.placement import GraspedPiece, ProbeObservation, make_strategy
from touchdown.backend.runs import ProbeRequest
from touchdown.widgets.base import MAPS, tr
from touchdown.widgets.forms import ProbePanel
from touchdown.widgets.plots import SPANS_S
from touchdown.widgets.shell import FaultCards
from touchdown.widgets.views import LOOKS, BeliefScene, signed_mm

PHASES = ("grip", "reference", "approach", "press", "hold", "lift")
# Commands of the page: name, text, key, action
COMMANDS: tuple[tuple[str, str, str, Callable[[OperatePage], object]], ...] = (
    ("probe", "Probe once", "F5", lambda page: page.probe.probe.clicked.emit()),
    ("grip", "Grip the piece", "G", lambda page: page.gripper.grip.clicked.emit()),
    ("open", "Open the gripper", "Shift+G", lambda page: page.gripper.open.clicked.emit()),
    ("zero", "Zero force and moment", "Z", lambda page: page.zero.clicked.emit()),
    ("baseline", "Take a new tactile reference", "B", lambda page: page.baseline.clicked.emit()),
    ("arm", "Arm or disarm the jog keys", "J", lambda page: page.jog.keys.toggle()),
    ("shorter", "Shorter step, down to hold-to-run", "[", lambda page: page.jog.pace.next_step(-1)),
    ("longer", "Longer step", "]", lambda page: page.jog.pace.next_step(1)),
    ("frame", "Jog in the next frame: XYZ, TOOL, JOINT", "F", lambda page: page.jog.next_frame()),
    ("turn", "Jog: turn the hand, or move it", "T", lambda page: page.jog.turn.click()),
    ("level", "Level the hand", "Shift+T", lambda page: page.jog.level.clicked.emit()),
    ("scene", "Set up a new scene on the simulated bench", "Ctrl+N", lambda page: page.scene.ask()),
    ("freeze", "Freeze the traces", "Ctrl+P", lambda page: page.pause.toggle()),
    ("fit", "Fit the force and moment ranges", "Ctrl+F", lambda page: page.fit()),
)


class SingleProbePresenter:
    """Starts a single probe and shows its result."""

    def __init__(self, bench: Session, panel: ProbePanel, cards: FaultCards) -> None:
        self._bench, self._panel, self._cards = bench, panel, cards
        self._mine = False
        self._felt: list[str] = []
        self.patch: core.PatchEstimated | None = None  # of the last probe, None after other runs
        self.piece, self._model = bench.usual.piece, bench.model
        panel.values.setText(values_text(ProbeSettings()))
        self.show_model()

    def start(self) -> None:
        """Start a single probe."""
        if not shell.is_run_active(self._bench):
            shell.carry_out(lambda: self._bench.start(ProbeRequest()), self._cards)

    def cancel(self) -> None:
        """End the probe in order."""
        if self._mine:
            self._bench.engine.cancel()

    def show_model(self) -> None:
        """Show the model that reads the next probe."""
        words = shell.scene_model_caption(self._model, self.piece, simulated=self._bench.simulated)
        self._panel.show_model(tr("Model: {}", tr(words.short)), tr(words.full))

    def take(self, event: core.Event) -> None:
        """Follow the events of a probe run."""
        if isinstance(event, core.RunStarted):
            self.piece = event.piece
            self._mine = event.activity == "probe"
            self._felt, self.patch = [], None
            if self._mine:
                self._panel.strip.show_phase(-1)
                self._panel.result.setText(tr("Probing."))
        if not self._mine:
            return
        if isinstance(event, core.PhaseEntered) and event.phase in PHASES:
            self._panel.strip.show_phase(PHASES.index(event.phase))
        elif isinstance(event, core.EpisodeRecorded):
            episode = event.episode
            self._felt.append(tr("largest Fz {:.1f} N", float(episode.observation[:, -4].max())))
            if not episode.quality.accepted:
                self._felt.append(tr("not an observation: {}", "; ".join(episode.quality.reasons)))
        elif isinstance(event, core.PatchEstimated):
            share, self.patch = float((event.patch.probability > 0.5).mean()), event
            self._felt.append(tr("contact on {:.0f} % of the face", 100 * share))
        elif isinstance(event, core.RunFinished):
            self._end(event)

    def story(self) -> shell.TrialStory | None:
        """Return the last probe as the paper's strategy reads it, None without a patch."""
        event, piece = self.patch, self._bench.catalogue.pieces.get(self.piece)
        if event is None or piece is None:
            return None
        held, here = GraspedPiece(piece.com_xy_mm, piece.grip_height_mm or 0.0), event.offset_mm
        method = self._bench.method.model_copy(update={"strategy": "paper"})
        # The paper's strategy reads the patch alone.
        felt = ProbeObservation(np.zeros((20, 258), np.float32), event.patch, here)
        found = make_strategy(held, method, here).conclude(felt)
        look = shell.ProbeStory(1, here, found.map, found.stability, found.action)
        return shell.TrialStory(1, 0, None, [look])

    def draw(self) -> None:
        """Enable the buttons that are allowed now."""
        active = shell.is_run_active(self._bench)
        why = "" if active else shell.start_obstacle(self._bench)
        if active and not self._mine:
            why = tr("A run is going on")
        self._panel.show_buttons(
            probe=not active and not why, cancel=active and self._mine, why=why
        )
        if self._bench.model is not self._model:
            self._model = self._bench.model
            self.show_model()

    def _end(self, event: core.RunFinished) -> None:
        self._mine = False
        done = event.ending == "finished"
        if done:
            self._panel.strip.show_phase(len(PHASES))
        felt = ", ".join(self._felt)
        told = f"{felt[:1].upper()}{felt[1:]}." if felt else ""
        self._panel.result.setText(told if done and told else f"{told} {event.reason}".strip())


def values_text(probe: ProbeSettings) -> str:
    """Return the settings of a probe in one line."""
    x, y, z = (f"{k:g}" for k in probe.stiffness_n_mm)
    values = "{:g} mm deep, {:g} s, stiffness {} {} {} N/mm, sampled at 10 Hz"
    return tr(values, probe.depth_mm, probe.duration_s, x, y, z)


NO_RUN = BeliefScene(
    empty=("No probe yet", "The map shows the patch of a single probe, or the last stacking run.")
)


@dataclass(frozen=True, slots=True)
class OperateMemory:
    """Stored settings of the page: entries of the lists, grip force per finger."""

    look: Annotated[int, Field(ge=0, lt=len(LOOKS))] = 0
    span: Annotated[int, Field(ge=0, lt=len(SPANS_S))] = 0
    map: Annotated[int, Field(ge=0, lt=len(MAPS))] = 0
    grip_n: float = 0.0


class OperateWorkspace(shell.Workspace):
    """Live views, belief of the last run, single probe, jog and gripper."""

    name, title, key = "operate", "Operate", "Ctrl+1"
    held_keys = ROWS
    page: OperatePage

    def __init__(self, context: shell.WorkspaceContext) -> None:
        self._context = context
        self.hand: ManualControlPresenter | None = None
        self.probe: SingleProbePresenter | None = None
        self._bench: Session | None = None
        self._story, self._shown = shell.RunStory(), (-1, 0)
        self.view: shell.BenchViewPresenter | None = None
        self.commands = tuple(
            shell.WindowCommand(name, text, key, partial(self._order, action))
            for name, text, key, action in COMMANDS
        )

    def build(self) -> Iterator[None]:
        """Create the page."""
        self.page = page = OperatePage(self._context.theme)
        yield
        yield from page.build(PACES, PHASES, self._renew)
        page.jog.keys.toggled.connect(self._arm_keys)
        page.pause.toggled.connect(self._pause)
        page.scene_chosen.connect(self._set_scene)
        self.page.belief.show_scene(NO_RUN)
        self.columns = self.lazy_pages = self.page.columns
        self.keys = JogKeyFilter(self.page, self.page.jog)

    def attach(self, bench: Session) -> None:
        """Connect the page to a bench."""
        page = self.page
        self._bench = bench
        self.live = shell.LivePresenter(bench, page)
        self.hand = ManualControlPresenter(bench, page, self._context.cards)
        self.probe = SingleProbePresenter(bench, page.probe, self._context.cards)
        self.view = shell.BenchViewPresenter(bench, page.side, page.side_panel)
        page.jog.hold_ended.connect(self.hand.ended)
        page.jog.step_pressed.connect(self.hand.step)
        page.jog.level.clicked.connect(self.hand.level)
        page.gripper.grip.clicked.connect(self.hand.grip)
        page.gripper.open.clicked.connect(self.hand.open)
        page.zero.clicked.connect(self.hand.zero)
        page.baseline.clicked.connect(self.hand.baseline)
        page.probe.probe.clicked.connect(self.probe.start)
        page.probe.cancel.clicked.connect(self.probe.cancel)
        page.span_chosen.connect(self.live.show_span)
        draws = self.hand.draw, self.probe.draw, self._draw_belief, self.view.draw
        self.parts = (*self.live.parts, *draws)

    def take(self, event: core.Event) -> None:
        """Handle one event of the bench."""
        self._story.take(event)
        if self.probe is not None and self.view is not None:
            self.probe.take(event)
            self.view.take(event)

    def show_waiting(self, word: str, why: str) -> None:
        """Show why no bench is connected yet."""
        self.page.show_waiting(why)

    def enter(self) -> None:
        """Show the model in use and the known pieces, which may have changed."""
        if self.probe is not None:
            self.probe.show_model()
        if self.hand is not None:
            self.hand.show_pieces()

    def leave(self) -> None:
        """End manual motion and disarm the keys."""
        self.page.jog.hold.end("another page was opened")
        self.keys.disarm()

    def reset_layout(self) -> None:
        """Select the first entry of all lists."""
        for chooser in (self.page.looks, self.page.span, self.page.maps):
            chooser.setCurrentIndex(0)

    def memory(self) -> shell.Memory:
        """Return the settings to store."""
        page = self.page
        look, span, shown = (box.currentIndex() for box in (page.looks, page.span, page.maps))
        return asdict(OperateMemory(look, span, shown, page.gripper.force.value()))

    def recall(self, memory: shell.Memory) -> Sequence[str]:
        """Restore stored settings; return the names of invalid fields."""
        page = self.page
        usual = OperateMemory(grip_n=page.gripper.force.value())
        mine, dropped = shell.restore_form(usual, memory)
        page.looks.setCurrentIndex(mine.look)
        page.span.setCurrentIndex(mine.span)
        page.maps.setCurrentIndex(mine.map)
        page.gripper.force.setValue(mine.grip_n)
        return dropped

    def close(self) -> None:
        """End manual motion."""
        self.leave()

    # -- orders -----------------------------------------------------------------------------------

    def _order(self, action: Callable[[OperatePage], object]) -> None:
        action(self.page)

    def _renew(self, what: str) -> bool:
        return self.hand is not None and self.hand.renew(what)

    def _arm_keys(self, on: bool) -> None:
        self.keys.arm(on and self.hand is not None and not self.hand.why_not())
        self.page.jog.show_armed(self.keys.armed)

    def _set_scene(self, piece: str, bottom: str) -> None:
        if self.hand is not None and self.page.scene.set.isEnabled():
            self.hand.set_scene(piece, bottom)

    def _pause(self, paused: bool) -> None:
        if self.live is not None:
            self.live.paused = paused

    def _draw_belief(self) -> None:
        """Show the single probe, if it is newer than the last stacking run, else that run."""
        if self._bench is None or self.probe is None or self.view is None:
            return
        now = self._story.version, id(self.probe.patch)
        if now == self._shown:
            return
        self._shown, single = now, self.probe.story()
        trial, panel = single or self._story.trial, self.page.belief_panel
        panel.rename("Last belief" if trial and not single else "Contact patch")
        if trial is None or not trial.probes:
            self.page.belief.show_scene(NO_RUN if trial is None else shell.unprobed_scene(trial))
            panel.detail.setText("")
            return
        face, bottom = shell.face_outlines(self._bench.catalogue, self._story.head)
        if single:
            face, bottom = self._bench.catalogue.piece(self.probe.piece).face, None
        scene = shell.belief_scene(trial, len(trial.probes) - 1, face, bottom)
        self.page.belief.show_scene(scene)
        self.page.legend.show_truth(scene.truth is not None)
        panel.detail.setText(tr("trial {}, probe {}", trial.trial, len(trial.probes)))
        if single and scene.stability is not None:
            panel.detail.setText(tr("margin {}", signed_mm(scene.stability.margin_mm)))
            (x, y), (dx, dy) = scene.path[0], scene.step_mm or (0.0, 0.0)
            self.view.next_mm = None if scene.step_mm is None else (x + dx, y + dy)
