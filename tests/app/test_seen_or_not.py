"""A run takes the same course whether a window looks on or not."""

import pytest

from tests.app.conftest import settle
from tests.backend.brisk import brisk_method
from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.config.method import PolicySettings
from touchdown.backend.core.events import RunFinished

STEPS_A_DRAW = 25
TWO_PROBES = brisk_method().model_copy(update={"policy": PolicySettings(max_probes=2)})


class Watched:
    """A session whose time the test turns while the window watches."""

    def __init__(self, session):
        self._session = session

    def __getattr__(self, name):
        return getattr(self._session, name)

    def open(self):
        """No thread."""


@pytest.mark.promise("W17")
def test_the_run_of_a_window_tells_the_same_facts_as_one_without(main, qtbot):
    alone = OracleSession(method=TWO_PROBES)
    alone.session.run(request(trials=1))
    seen = OracleSession(method=TWO_PROBES)
    seen.session.prepare(request(seed=99).scene())
    main.attach(Watched(seen.session))
    main.window.show()
    seen.session.start(request(trials=1))
    for step in range(20_000):
        seen.session.engine.tick()
        seen.session.advance()
        if step % STEPS_A_DRAW == 0:
            main.pump.tick()
        if seen.of(RunFinished):
            break
    settle(main, 60)
    assert seen.record() == alone.record()
    story = main.workspaces["stack"].presenter.story
    assert len(story.trials[-1].probes) == len(alone.oracles[-1].asked)
