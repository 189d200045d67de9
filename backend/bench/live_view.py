"""Live view of a bench in Foxglove: its signals and events on the topics of an episode file.

A thread of its own reads the streams and hands messages to the server of the Foxglove SDK, which
has a queue per client. All queues are bounded and nothing waits: what is late is left out.
"""

from __future__ import annotations

import ipaddress
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from importlib import import_module
from itertools import chain

import numpy as np

from touchdown.backend.bench.session import Session
from touchdown.backend.core import BeliefUpdated, EpisodeRecorded, Event, EventQueue, InputError
from touchdown.backend.episodes import (
    BELIEF_TOPIC,
    EVENT_TOPIC,
    LIVE_TOPICS,
    StampedMessages,
    Topic,
    image_messages,
    make_frames,
    pack_belief,
    pack_json,
    recording_messages,
    schema_text,
    to_ns,
)
from touchdown.backend.runs import encode_event

PERIOD_S = 0.04
LAG_S = 0.1  # signals are shown this late, when the tracked pictures have arrived
MOST_S = 0.2  # of bench time in one period; earlier signals are left out
MOST_EVENTS, BACKLOG = 256, 256  # events that wait, and messages that wait for one client
CLOSE_S = 2.0
Publish = Callable[[Topic, int, bytes], None]
log = logging.getLogger("touchdown")


class LiveView:
    """Publishes a session on its own thread until ``close``.

    ``publish`` receives topic, log time in ns and message; ``wanted`` tells whether somebody reads
    a topic. ``dropped`` events and ``skipped_s`` seconds of signals were left out.
    """

    def __init__(self, session: Session, publish: Publish, wanted: Callable[[Topic], bool]) -> None:
        self._session, self._publish, self._wanted = session, publish, wanted
        self._facts = session.description.model_dump_json()
        self._frames = make_frames(self._facts, {}, (0, 0))
        self.events = EventQueue(MOST_EVENTS)
        self._leave = session.events.subscribe(self.events)
        session.served = True
        self.skipped_s = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="live view", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, waiting for ``CLOSE_S`` at most, and log what was left out."""
        self._leave()
        self._closing.set()
        self._thread.join(CLOSE_S)
        if self.events.dropped or self.skipped_s:
            text = "The live view left out %d events and %.1f s of signals."
            log.warning(text, self.events.dropped, self.skipped_s)

    def _serve(self) -> None:
        shown_s = self._session.clock_s() - LAG_S
        while not self._closing.wait(PERIOD_S):
            end_s = self._session.clock_s() - LAG_S
            # The clock of a new scene starts at zero.
            start_s = max(min(shown_s, end_s), end_s - MOST_S)
            self.skipped_s += max(0.0, start_s - shown_s)
            shown_s = end_s
            recording = self._session.recording(math.nextafter(start_s, math.inf), end_s)
            if recording is not None:
                signals = recording_messages(recording, self._frames)
                self._send(chain(signals, image_messages(recording, "jpeg95_444")))
            while (event := self.events.take()) is not None:
                self._event(event)

    def _send(self, parts: Iterable[StampedMessages]) -> None:
        for topic, _, _, messages in parts:
            if self._wanted(topic):
                for message in messages:
                    self._publish(topic, time.time_ns(), bytes(message))

    def _event(self, event: Event) -> None:
        content, stamp, first = encode_event(event), to_ns([event.t_s]), np.zeros(1, np.int64)
        note = pack_json({"event": content.pop("kind"), **content})
        self._send([(EVENT_TOPIC, stamp, first, [note])])
        if isinstance(event, BeliefUpdated):
            self._send([(BELIEF_TOPIC, stamp, first, [pack_belief(int(stamp[0]), event.belief)])])
        if isinstance(event, EpisodeRecorded):
            self._frames = make_frames(self._facts, dict(event.episode.metadata), (0, 0))


def serve_live(session: Session, address: str = "127.0.0.1:8765") -> str:
    """Serve a session to Foxglove until it is closed.

    Parameters
    ----------
    session : Session
        The bench whose signals and events are served.
    address : str
        HOST:PORT. Beyond the loopback interface everyone who reaches it can read.

    Returns
    -------
    str
        A sentence with the address, and with the risk beyond the loopback interface.

    Raises
    ------
    InputError
        Without the Foxglove SDK (extra ``live``), or if the address cannot be used.

    Examples
    --------
    >>> with simulated_bench() as bench:  # doctest: +SKIP
    ...     print(serve_live(bench))
    ...     bench.run(StackRequest(seed=7))

    """
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
        foxglove = import_module("foxglove")
        context = foxglove.Context()
        server = foxglove.start_server(name="Touchdown", host=host, port=int(port),
                                       context=context, message_backlog_size=BACKLOG)  # fmt: skip
    except ImportError as error:
        fix = "Install it: pip install 'touchdown[live]'."
        raise InputError("The package 'foxglove-sdk' is not installed.", "--live", fix) from error
    except (ValueError, OverflowError, RuntimeError, OSError) as error:
        what, fix = f"Nothing can be served at '{address}': {error}.", "Write a free HOST:PORT."
        raise InputError(what, "--live", fix) from error
    channels = {}
    for topic in LIVE_TOPICS:
        text = schema_text(topic.schema)
        schema = foxglove.Schema(name=topic.schema, encoding="ros2msg", data=text)
        channels[topic.name] = foxglove.Channel(
            topic.name, message_encoding="cdr", schema=schema, context=context
        )
    view = LiveView(
        session,
        lambda topic, log_ns, message: channels[topic.name].log(message, log_time=log_ns),
        lambda topic: bool(channels[topic.name].has_sinks()),
    )

    def stop(_: object) -> None:
        # It waits for ever for a connection that sends no handshake.
        stopping = threading.Thread(target=server.stop, name="live view stops", daemon=True)
        stopping.start()
        stopping.join(CLOSE_S)

    # Neither server nor channels keep their context alive.
    session.resources.callback(stop, context)
    session.resources.callback(view.close)
    risk = " Everyone who reaches this address sees pictures and events: there is no password."
    return f"Live at ws://{host}:{server.port}.{'' if loopback else risk}"
