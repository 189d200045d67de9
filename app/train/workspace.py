"""Train workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from touchdown.app import shell
from touchdown.app.train.page import TrainPage
from touchdown.app.train.presenter import TrainPresenter
from touchdown.app.train.reading import TrainingReader
from touchdown.backend.learning import ModelRegistry
from touchdown.backend.runs import dataset_folder, models_folder
from touchdown.widgets.base import tr
from touchdown.widgets.forms import TrainingForm

MOST_FOLDERS = 8


class TrainWorkspace(shell.Workspace):
    """Training runs, their comparison, and the model in use. Reads when it is first entered."""

    name, title, key = "train", "Train", "Ctrl+3"
    page: TrainPage

    def __init__(self, context: shell.WorkspaceContext) -> None:
        self._context = context
        self.presenter: TrainPresenter | None = None
        self._worker: shell.SaveWorker | None = None
        self._folders = [dataset_folder()]
        self.commands = (
            shell.WindowCommand("start", "Start training", "Ctrl+Return",
                                self._order(TrainPresenter.start)),
            shell.WindowCommand("resume", "Resume the chosen training", "Ctrl+Shift+Return",
                                self._order(TrainPresenter.resume)),
            shell.WindowCommand("cancel", "Cancel the training", "Esc",
                                self._order(TrainPresenter.ask_cancel)),
            shell.WindowCommand("promote", "Put the chosen model in use", "Ctrl+P",
                                self._order(TrainPresenter.promote)),
            shell.WindowCommand("roll-back", "Use the previous model again", "Ctrl+Shift+P",
                                self._order(TrainPresenter.roll_back)),
            shell.WindowCommand("folder", "Train on another folder", "Ctrl+O", self._ask_folder),
            shell.WindowCommand("reread", "Read data and trainings again", "Ctrl+R", self._reread),
        )  # fmt: skip

    def build(self) -> Iterator[None]:
        """Create the page."""
        self.page = page = TrainPage(self._context.theme)
        yield
        yield from page.build()
        page.form.start.clicked.connect(self._order(TrainPresenter.start))
        page.form.cancel.clicked.connect(self._order(TrainPresenter.ask_cancel))
        page.form.resume.clicked.connect(self._order(TrainPresenter.resume))
        page.form.changed.connect(self._order(TrainPresenter.look))
        page.form.folder.clicked.connect(self._ask_folder)
        page.form.defaults.clicked.connect(self._defaults)
        page.runs_chosen.connect(lambda _: self._on(TrainPresenter.choose))
        page.step.clicked.connect(self._order(TrainPresenter.carry_out_step))
        page.promote.clicked.connect(self._order(TrainPresenter.promote))
        page.roll_back.clicked.connect(self._order(TrainPresenter.roll_back))
        self.columns = self.lazy_pages = self.page.columns
        self._show_folders(str(dataset_folder()))
        self.page.form.show_form(TrainingForm())

    def enter(self) -> None:
        """Read datasets and training runs, which may have changed."""
        if self.presenter is None:
            self._worker = shell.SaveWorker(self.page, "train-reading")
            reading = TrainingReader(ModelRegistry(models_folder()))
            cards = self._context.cards
            self.presenter = TrainPresenter(self.page, cards, reading, self._worker)
            self.presenter.offer = self._context.offer
            self.presenter.collect = partial(self._context.go, "collect")
        self._reread()

    def close(self) -> None:
        """End the training and the reading thread; finished epochs are kept."""
        if self.presenter is not None:
            self.presenter.close()
        if self._worker is not None:
            self._worker.close()
            self._worker = None
        self.presenter = None

    def memory(self) -> shell.Memory:
        """Return form and folders to store."""
        form = self.page.form.form()
        return {**asdict(form), "folders": [str(folder) for folder in self._folders[1:]]}

    def recall(self, memory: shell.Memory) -> Sequence[str]:
        """Restore stored settings; return the names of invalid fields."""
        form, dropped = shell.restore_form(TrainingForm(), memory)
        folders = memory.get("folders", [])
        if isinstance(folders, list) and all(isinstance(one, str) for one in folders):
            self._folders = [self._folders[0], *(Path(one) for one in folders[:MOST_FOLDERS])]
        else:
            dropped.append("folders")
        self._show_folders(form.data)
        self.page.form.show_pieces([(form.piece, form.piece)] if form.piece else [], form.piece)
        self.page.form.show_form(form)
        return dropped

    def take_folder(self, folder: Path) -> None:
        """Train on ``folder``."""
        if folder not in self._folders:
            self._folders = [*self._folders, folder][-MOST_FOLDERS:]
            self._folders = [dataset_folder(), *(f for f in self._folders if f != dataset_folder())]
        self._show_folders(str(folder))
        self._reread()

    # -- orders -----------------------------------------------------------------------------------

    def _on(self, order: Callable[[TrainPresenter], None]) -> None:
        if self.presenter is not None:
            order(self.presenter)

    def _order(self, order: Callable[[TrainPresenter], None]) -> Callable[[], None]:
        return lambda: self._on(order)

    def _reread(self) -> None:
        self._on(lambda presenter: presenter.look(refresh=True))

    def _defaults(self) -> None:
        form, default = self.page.form.form(), TrainingForm()
        kept = {"data": form.data, "labels": form.labels, "piece": form.piece}
        self.page.form.show_form(TrainingForm(**{**asdict(default), **kept}))
        self._on(TrainPresenter.look)

    def _ask_folder(self) -> None:
        shell.ask_path(self.page, "Folder of a dataset, or of simulated packs", self.take_folder)

    def _show_folders(self, chosen: str) -> None:
        own = dataset_folder()
        names = [one.name for one in self._folders]
        entries = [
            (
                str(one),
                tr("Own dataset")
                if one == own
                else "/".join(one.parts[-2:] if names.count(one.name) > 1 else one.parts[-1:]),
            )
            for one in self._folders
        ]
        self.page.form.show_data(entries, chosen)
